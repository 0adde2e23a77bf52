"""ASTRA: grounding by self-prediction, the predicted reward, an aligned target encoder (Section IV)."""

from astra_data.method import Method
from astra_data.models.grounding import LossWeights

ASTRA = Method(
    name="astra",
    title="ASTRA",
    loss_weights=LossWeights(latent=1.0, reward=1.0, state=1.0),
    reward="predicted",
    aligns=True,
)
