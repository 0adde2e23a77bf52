"""Domain randomization: noise and scaling of the actions (Section V-A, "DR uses action noise … and scaling").

The paper's N(0, 0.05) is read as a standard deviation of 0.05, of commands of ±1; δ is redrawn for every
episode. The task has the ranges.
"""

from astra_data.methods.method import Method
from astra_data.policies.train import InSimulator

DOMAIN_RANDOMIZATION = Method(
    name="domain_randomization",
    title="Domain randomization",
    color="#CC79A7",
    learn=InSimulator(ranges="randomized"),
)
