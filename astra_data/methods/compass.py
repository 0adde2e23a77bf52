"""COMPASS as the paper describes it: every episode draws its simulator parameters from printed ranges.

Huang et al. (CoRL 2023) identify the parameters instead, by a causal model of the gap; the paper prints
uniform ranges (Section V-A).
"""

from astra_data.methods.method import Method
from astra_data.policies.train import InSimulator

COMPASS = Method(name="compass", title="COMPASS", color="#B8A000", learn=InSimulator(ranges="wide"))
