"""Names of our columns in the files of other libraries, for importers and exporters."""

from collections.abc import Iterable

from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED

D4RL = {
    STATE: "observations",
    ACTION: "actions",
    REWARD: "rewards",
    TERMINATED: "terminals",
    TRUNCATED: "timeouts",
    NEXT_STATE: "next_observations",
    GOAL: "infos/goal",
}
ROBOMIMIC = {ACTION: "actions", REWARD: "rewards", TERMINATED: "dones", TRUNCATED: "truncated"}
"""Per demonstration; its learners take `dones` for terminated, and `truncated` is ours."""
D3RLPY = {STATE: "observations", ACTION: "actions", REWARD: "rewards", TERMINATED: "terminated"}
"""Per episode, with its number at the end of the name; `terminated` is a single value."""
MINARI = {ACTION: "actions", REWARD: "rewards", TERMINATED: "terminations", TRUNCATED: "truncations"}

NUMBERED = "{field}_{number}"
"""The pattern of episodes whose fields have the episode's number at the end of their names."""
RECORD = "metadata/astra_data"
"""Where HDF5 files hold the record of an export."""


def extra_fields(columns: Iterable[str], known: Iterable[str]) -> dict[str, str]:
    """Return the fields of the columns for which a format has no name of its own."""
    return {name: f"infos/{name}" for name in columns if name not in known}
