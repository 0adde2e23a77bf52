"""Names of our columns in the files of other libraries, for importers and exporters."""

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
