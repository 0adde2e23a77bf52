"""ASTRA: grounding by self-prediction, the predicted reward, an aligned target encoder (Section IV).

The paper prints no weights. λ1 = 0.1: at 1 the latent loss crowds out the correction (held-out R² 0.826
against 0.835 of NAS on the Long Maze, 200-step position error 0.92 m against 0.65 m; at 0.1: 0.833, 0.72 m).
"""

from dataclasses import replace

from astra_data.fitting import HistoryFit
from astra_data.method import Method
from astra_data.models.grounding import LossWeights
from astra_data.training import InSimulator

ASTRA = Method(
    name="astra",
    title="ASTRA",
    fit=HistoryFit(LossWeights(latent=0.1, reward=1.0, state=1.0)),
    learn=InSimulator(reward="predicted"),
    aligns=True,
)

ASTRA_WITHOUT_LATENT = replace(
    ASTRA,
    name="astra_without_latent",
    title="ASTRA w/o L_trans",
    fit=HistoryFit(LossWeights(latent=0.0, reward=1.0, state=1.0)),
    aligns=False,
)
"""Table II, "w/o dynamics". P_lat is not trained, so there is nothing to align by: ψ^s is deployed."""

ASTRA_WITHOUT_REWARD = replace(
    ASTRA,
    name="astra_without_reward",
    title="ASTRA w/o L_rew",
    fit=HistoryFit(LossWeights(latent=0.1, reward=0.0, state=1.0)),
    learn=InSimulator(),
)
"""Table II, "w/o reward". Without R_pred the policy learns from the task's own reward."""

ASTRA_TASK_REWARD = replace(
    ASTRA,
    name="astra_task_reward",
    title="ASTRA, task reward",
    learn=InSimulator(reward="abstract"),
    grounded_as="astra",
)
"""The grounding of ASTRA; the policy learns from the task's own reward on corrected states."""
