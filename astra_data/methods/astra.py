"""ASTRA: grounding by self-prediction, the predicted reward, an aligned target encoder (Section IV).

The paper prints no weights. λ1 = 0.1: at 1 the latent loss crowds out the correction (held-out R² 0.826
against 0.835 of NAS on the Long Maze, 200-step position error 0.92 m against 0.65 m; at 0.1: 0.833, 0.72 m).
"""

from astra_data.method import Method
from astra_data.models.grounding import LossWeights

ASTRA = Method(
    name="astra",
    title="ASTRA",
    loss_weights=LossWeights(latent=0.1, reward=1.0, state=1.0),
    reward="predicted",
    aligns=True,
)
