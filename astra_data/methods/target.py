"""Target and Full Obs: policies trained in the target on φ(s), or on the complete state (Section V-A)."""

from astra_data.method import Method
from astra_data.target_training import TargetPpo

TARGET = Method(name="target", title="Target", learn=TargetPpo("abstract"))

FULL_OBS = Method(name="full_obs", title="Full Obs", learn=TargetPpo("full"), table="target")
