"""Target and Full Obs: policies trained in the target on φ(s), or on the complete state (Section V-A)."""

from dataclasses import replace

from astra_data.methods.method import Method, Table
from astra_data.policies.train_in_target import InTarget, TargetConfig

TARGET = Method(
    name="target",
    title="Target",
    color="#4D4D4D",
    role="trained there",
    learn=InTarget("abstract"),
    learns_from="target",
    table=Table("target", TargetConfig),
)

FULL_OBS = replace(TARGET, name="full_obs", title="Full Obs", color="#1A1A1A", learn=InTarget("full"))
