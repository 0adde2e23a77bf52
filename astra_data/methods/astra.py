"""ASTRA: grounding by self-prediction, the predicted reward, an aligned target encoder (Section IV); its baselines."""

from dataclasses import replace
from typing import Any

from astra_data.grounding.fit import HistoryFit
from astra_data.methods.method import Method, Table
from astra_data.policies.train import InSimulator, InTarget, TargetConfig

_FIT = HistoryFit(latent=True, reward=True)
ASTRA = Method(
    name="astra", title="ASTRA", color="#009E73", fit=_FIT, learn=InSimulator(reward="predicted"), aligns=True
)


def _changed(name: str, title: str, color: str, **changes: Any) -> Method:
    return replace(ASTRA, name=f"astra_{name}", title=title, color=color, **changes)


ABLATIONS = (
    # Table II, "w/o dynamics". P_lat is not trained, so no target encoder can be aligned: ψ^s is deployed.
    _changed("without_latent", "ASTRA w/o L_trans", "#44AA99", fit=replace(_FIT, latent=False), aligns=False),
    # Table II, "w/o reward". Without R_pred the policy learns from the task's own reward.
    _changed("without_reward", "ASTRA w/o L_rew", "#999933", fit=replace(_FIT, reward=False), learn=InSimulator()),
    # ASTRA's grounding; the policy is trained with the task's own reward on corrected states.
    _changed("task_reward", "ASTRA, task reward", "#117733", learn=InSimulator(), grounded_as="astra"),
    # R_pred learns failures with the rest of the reward.
    _changed("without_failures", "ASTRA w/o failure model", "#DDCC77", fit=replace(_FIT, failures=False)),
    # Corrected steps are as smooth as the correction is.
    _changed("without_scatter", "ASTRA w/o scatter", "#CC6677", fit=replace(_FIT, scatter=False)),
    # The paper's losses alone: R_pred learns the whole reward; corrections go as close to walls as the simulator.
    _changed("printed", "ASTRA as printed", "#5E4FA2", fit=replace(_FIT, failures=False, scatter=False, printed=True)),
)

NAS = Method(name="nas", title="NAS", color="#56B4E9", fit=replace(_FIT, latent=False, reward=False))
# A recurrent policy trained in the raw simulator and deployed unchanged.
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
