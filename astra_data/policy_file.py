"""Policies on disk: one safetensors file with the networks and the world that they were trained in."""

from dataclasses import asdict, dataclass
from pathlib import Path

from torch import Tensor

from astra_data.checkpoint import load_tensors, save_tensors
from astra_data.models.actor_critic import ActorCritic, ActorCriticShape
from astra_data.training_world import WorldConfig


@dataclass(frozen=True)
class PolicyFile:
    """A trained policy.

    Attributes:
        policy: the networks.
        thinness: of the data that it was trained on, (height, width).
        scatter: factor of the noise added in training, (X, X); zeros where there was none.
        world: the switches of the training world.
        dataset, content_hash: the dataset that everything was learned from.
    """

    policy: ActorCritic
    thinness: Tensor
    scatter: Tensor
    world: WorldConfig
    dataset: str
    content_hash: str

    def save(self, path: Path) -> None:
        """Write the policy to `path`."""
        tensors = {f"policy.{name}": tensor for name, tensor in self.policy.state_dict().items()}
        tensors |= {"thinness": self.thinness, "scatter": self.scatter}
        told = {
            "shape": asdict(self.policy.shape),
            "world": self.world.model_dump(mode="json"),
            "dataset": self.dataset,
            "hash": self.content_hash,
        }
        save_tensors(path, tensors, told)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> "PolicyFile":
        """Read a policy; its parameters are frozen."""
        tensors, told = load_tensors(path)
        told["shape"]["hidden_sizes"] = tuple(told["shape"]["hidden_sizes"])
        policy = ActorCritic(ActorCriticShape(**told["shape"]))
        prefix = "policy."
        policy.load_state_dict(
            {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
        )
        return cls(
            policy.to(device).requires_grad_(False),
            tensors["thinness"].to(device),
            tensors["scatter"].to(device),
            WorldConfig(**told["world"]),
            told["dataset"],
            told["hash"],
        )
