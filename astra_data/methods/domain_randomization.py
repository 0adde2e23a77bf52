"""Domain randomization: noise and scaling of the actions (Section V-A, "DR uses action noise … and scaling").

The paper's N(0, 0.05) is read as a standard deviation of 0.05 m/s; δ is drawn anew for every episode.
"""

from astra_data.method import Method
from astra_data.training import InSimulator
from astra_data.variation import RANDOMIZED_ACTIONS

DOMAIN_RANDOMIZATION = Method(
    name="domain_randomization",
    title="Domain randomization",
    learn=InSimulator(variation=RANDOMIZED_ACTIONS),
    planar=True,
)
