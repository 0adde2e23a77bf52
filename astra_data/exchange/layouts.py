"""What other libraries call our columns in their files, for who reads them and who writes them."""

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
