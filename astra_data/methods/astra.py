"""ASTRA: grounding by self-prediction, the predicted reward, an aligned target encoder (Section IV); its baselines."""

from dataclasses import replace
from typing import Any

from astra_data.grounding.fit import HistoryFit
from astra_data.methods.method import Method, Table
from astra_data.policies.train import InSimulator, InTarget, TargetConfig

_FIT = HistoryFit(latent=True, reward=True)
ASTRA = Method("astra", "ASTRA", "#009E73", fit=_FIT, learn=InSimulator(reward="predicted"), aligns=True)


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

NAS = Method("nas", "NAS", "#56B4E9", fit=replace(_FIT, latent=False, reward=False))
# A recurrent policy trained in the raw simulator and deployed unchanged.
DIRECT_TRANSFER = Method("direct_transfer", "Direct transfer", "#E69F00", role="floor")
_RANDOMIZED = InSimulator(ranges="randomized")
DOMAIN_RANDOMIZATION = Method("domain_randomization", "Domain randomization", "#CC79A7", learn=_RANDOMIZED)
COMPASS = Method("compass", "COMPASS", "#B8A000", learn=InSimulator(ranges="wide"))
_TABLE = Table("target", TargetConfig)
TARGET = Method(
    "target", "Target", "#4D4D4D", "trained there", learn=InTarget("abstract"), learns_from="target", table=_TABLE
)
FULL_OBS = replace(TARGET, name="full_obs", title="Full Obs", color="#1A1A1A", learn=InTarget("full"))
