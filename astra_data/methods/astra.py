"""ASTRA: grounding by self-prediction, the predicted reward, an aligned target encoder (Section IV)."""

from dataclasses import replace

from astra_data.grounding.fit import HistoryFit
from astra_data.methods.method import Method
from astra_data.policies.train import InSimulator

ASTRA = Method(
    name="astra",
    title="ASTRA",
    color="#009E73",
    fit=HistoryFit(latent=True, reward=True),
    learn=InSimulator(reward="predicted"),
    aligns=True,
)

ASTRA_WITHOUT_LATENT = replace(
    ASTRA,
    name="astra_without_latent",
    title="ASTRA w/o L_trans",
    color="#44AA99",
    fit=HistoryFit(latent=False, reward=True),
    aligns=False,
)
"""Table II, "w/o dynamics". P_lat is not trained, so no target encoder can be aligned: ψ^s is deployed."""

ASTRA_WITHOUT_REWARD = replace(
    ASTRA,
    name="astra_without_reward",
    title="ASTRA w/o L_rew",
    color="#999933",
    fit=HistoryFit(latent=True, reward=False),
    learn=InSimulator(),
)
"""Table II, "w/o reward". Without R_pred the policy learns from the task's own reward."""

ASTRA_TASK_REWARD = replace(
    ASTRA,
    name="astra_task_reward",
    title="ASTRA, task reward",
    color="#117733",
    learn=InSimulator(),
    grounded_as="astra",
)
"""ASTRA's grounding; the policy is trained with the task's own reward on corrected states."""

ASTRA_WITHOUT_FAILURES = replace(
    ASTRA,
    name="astra_without_failures",
    title="ASTRA w/o failure model",
    color="#DDCC77",
    fit=HistoryFit(latent=True, reward=True, failures=False),
)
"""R_pred learns failures with the rest of the reward."""

ASTRA_WITHOUT_SCATTER = replace(
    ASTRA,
    name="astra_without_scatter",
    title="ASTRA w/o scatter",
    color="#CC6677",
    fit=HistoryFit(latent=True, reward=True, scatter=False),
)
"""Corrected steps are as smooth as the correction is."""

ASTRA_PRINTED = replace(
    ASTRA,
    name="astra_printed",
    title="ASTRA as printed",
    color="#5E4FA2",
    fit=HistoryFit(latent=True, reward=True, failures=False, scatter=False, printed=True),
)
"""The paper's losses and nothing else: R_pred learns the whole reward, no failure model, no scatter, and
corrections as close to walls as the simulator goes."""


NAS = Method(name="nas", title="NAS", color="#56B4E9", fit=HistoryFit(latent=False, reward=False))
