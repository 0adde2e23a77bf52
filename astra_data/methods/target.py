"""Target and Full Obs: policies trained in the target on φ(s), or on the complete state (Section V-A)."""

from astra_data.methods.method import Method
from astra_data.training.train_in_target import InTarget

TARGET = Method(name="target", title="Target", learn=InTarget("abstract"))

FULL_OBS = Method(name="full_obs", title="Full Obs", learn=InTarget("full"), table="target")
