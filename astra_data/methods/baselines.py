"""Direct transfer: a recurrent policy trained in the raw simulator and deployed unchanged (the floor)."""

from dataclasses import replace

from astra_data.methods.method import Method, Table
from astra_data.policies.train import InSimulator, InTarget, TargetConfig

DIRECT_TRANSFER = Method(name="direct_transfer", title="Direct transfer", color="#E69F00", role="floor")


DOMAIN_RANDOMIZATION = Method(
    name="domain_randomization", title="Domain randomization", color="#CC79A7", learn=InSimulator(ranges="randomized")
)


COMPASS = Method(name="compass", title="COMPASS", color="#B8A000", learn=InSimulator(ranges="wide"))


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
