"""NAS in the paper's sense: the correction alone, λ = (0, 0, 1) (Section V-E; after Golemo et al. 2018).

The reward is the task's own on corrected states, as Golemo et al. recompute it.
"""

from astra_data.grounding.fit import HistoryFit
from astra_data.methods.method import Method

NAS = Method(name="nas", title="NAS", color="#56B4E9", fit=HistoryFit(latent=False, reward=False))
