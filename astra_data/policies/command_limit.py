"""How long commands of the plus settings may be."""

import torch

from astra_data.grounding.failures import failing
from astra_data.grounding.networks.paired_windows import RISK_STEPS
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.worlds.objective import NO_LIMIT
from astra_data.worlds.task import Task

_ALONG_AN_AXIS = 1.0
_LEAST_RATIO = 1.5
"""Of the rates of failures above and below the limit."""


@torch.no_grad()
def command_limit(task: Task, episodes: PairedEpisodes) -> float:
    """Return 1, the largest velocity command along an axis, if failures are more frequent above it.

    Each step counts with the mean length of the commands up to it over `RISK_STEPS`; diagonal ones may be √2
    long. `NO_LIMIT` if the recorded rate of failures above 1 is less than 1.5 times that below.
    """
    if task.plane is None:
        return NO_LIMIT
    windows = episodes.windows
    length = windows.action[..., :2].norm(dim=-1).double() * windows.mask
    total, count = length.cumsum(1), windows.mask.double().cumsum(1)
    total[:, RISK_STEPS:] -= length.cumsum(1)[:, :-RISK_STEPS]
    is_above = episodes.steps(total / count.clamp(min=1, max=RISK_STEPS)) > _ALONG_AN_AXIS
    fails = episodes.steps(failing(task, episodes, 1).windows.fails_soon).double()
    above, below = fails[is_above], fails[~is_above]
    if not above.any():
        return NO_LIMIT
    is_riskier = not len(below) or float(above.mean()) >= _LEAST_RATIO * float(below.mean())
    return _ALONG_AN_AXIS if is_riskier else NO_LIMIT
