"""The models that a study compares, as its page and its figure show them."""

from dataclasses import dataclass, replace

from astra_data.methods import METHODS


@dataclass(frozen=True)
class Model:
    """How a model is shown.

    Attributes:
        title: in tables and figures. color: in figures, as "#rrggbb". text: what it is, in a clause.
    """

    title: str
    color: str
    text: str


def _of_method(name: str, text: str) -> Model:
    return Model(METHODS[name].title, METHODS[name].color, text)


MODELS = {
    "raw": Model(
        "Raw simulator",
        "#2B2B2B",
        "a planar body that moves immediately as the published code and speed limits specify",
    ),
    "gains": Model(
        "One gain per axis", "#B58900", "the same with one constant gain per axis, by least squares"
    ),
    "ridge": Model(
        "Ridge regression",
        "#D33682",
        "linear in the last H steps, in closed form; regularization chosen on training data",
    ),
    "mlp": Model(
        "Feed-forward network",
        "#6C71C4",
        "a feed-forward network on the same H steps, as in the lab's earlier grounding",
    ),
    "nas": _of_method(
        "nas", "the GRU of the grounding model, with only the correction's loss, λ = (0, 0, 1)"
    ),
    "astra": _of_method(
        "astra",
        "the same with all three losses, λ = (0.1, 1, 1); the logs have no reward, so L_rew predicts "
        "how much closer the ball gets",
    ),
}
"""Of a walk, by the names in a study's recipe."""

MODELS_OF_JOINTS = MODELS | {
    "raw": replace(MODELS["raw"], text="joints that approach their targets with the time constant"),
    "gains": replace(
        MODELS["gains"],
        title="Second-order response",
        text="stiffness, damping and a constant pull of each joint, by least squares",
    ),
    "mlp": replace(MODELS["mlp"], text="a feed-forward network on the same H steps"),
    "astra": replace(
        MODELS["astra"],
        text="the same with all three losses, λ = (0.1, 1, 1); the logs have no reward, so L_rew predicts "
        "how much closer the joints get to their targets",
    ),
}
"""Of joints."""
