"""Policies on disk: one safetensors file with the networks and all that is needed to run them."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from astra_data.core.checkpoint import save_tensors, understood
from astra_data.grounding.protocols import Grounding
from astra_data.grounding.raw import NO_GROUNDING
from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.learning.networks.adaptation import AdaptiveShape, Student
from astra_data.learning.networks.alignment import TargetEncoder
from astra_data.learning.networks.policy import Policy, PolicyShape
from astra_data.learning.networks.soft_actor import SoftActor
from astra_data.training.build_env import EnvConfig
from astra_data.training.deployment import DeployedPolicy, Observed
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation

_KINDS: dict[str, tuple[type[Policy], type[PolicyShape]]] = {
    "actor_critic": (ActorCritic, ActorCriticShape),
    "adaptive": (Student, AdaptiveShape),
    "soft_actor": (SoftActor, PolicyShape),
}


@dataclass(frozen=True)
class Simulation:
    """The abstract simulator that a policy was trained in.

    Attributes:
        thinness: of the data, (height, width); None where there is no maze.
        scatter: factor of the noise added in training, (X, X); zeros where there was none.
        world: the switches of the environment.
        variation: ranges of the simulator's parameters, drawn for each episode.
    """

    thinness: Tensor | None
    scatter: Tensor
    world: EnvConfig
    variation: Variation | None = None


@dataclass(frozen=True)
class PolicyFile:
    """A trained policy.

    Attributes:
        policy: the networks.
        simulation: the simulator that it was trained in; None if it was trained in the target, or on data.
        dataset, content_hash: the dataset that everything was learned from; None for a policy that was
            trained to collect one.
        observed: which part of the target's state it observes.
    """

    policy: Policy
    simulation: Simulation | None
    dataset: str | None
    content_hash: str | None
    observed: Observed = "abstract"

    def save(self, path: Path) -> None:
        """Write the policy to `path`."""
        tensors = {f"policy.{name}": tensor for name, tensor in self.policy.state_dict().items()}
        metadata: dict[str, Any] = {
            "kind": next(kind for kind, (made, _) in _KINDS.items() if type(self.policy) is made),
            "shape": asdict(self.policy.shape),
            "dataset": self.dataset,
            "hash": self.content_hash,
            "observed": self.observed,
        }
        if self.simulation:
            tensors["scatter"] = self.simulation.scatter
            if self.simulation.thinness is not None:
                tensors["thinness"] = self.simulation.thinness
            variation = self.simulation.variation
            metadata["simulation"] = {
                "world": self.simulation.world.model_dump(mode="json"),
                "variation": variation.model_dump() if variation else None,
            }
        save_tensors(path, tensors, metadata)

    @classmethod
    def load(cls, path: Path | str, device: str = "cpu") -> "PolicyFile":
        """Read a policy; its parameters are frozen.

        Raises:
            BadInputError: the file is missing, holds something else, or is from an older version.
        """
        with understood(Path(path), "a policy", _KINDS, device) as (tensors, metadata):
            shape = metadata["shape"] | {"hidden_sizes": tuple(metadata["shape"]["hidden_sizes"])}
            made, shaped = _KINDS[metadata["kind"]]
            policy = made(shaped(**shape))
            prefix = "policy."
            policy.load_state_dict(
                {
                    name.removeprefix(prefix): value
                    for name, value in tensors.items()
                    if name.startswith(prefix)
                }
            )
            simulation = None
            if recorded := metadata.get("simulation"):
                variation = recorded["variation"]
                simulation = Simulation(
                    tensors.get("thinness"),
                    tensors["scatter"],
                    EnvConfig(**recorded["world"]),
                    Variation.of_json(variation) if variation else None,
                )
            read = cls(policy, simulation, metadata["dataset"], metadata["hash"], metadata["observed"])
        policy.to(device).requires_grad_(False)
        return read


def deploy(
    task: Task,
    trained: PolicyFile,
    grounding: Grounding = NO_GROUNDING,
    target_encoder: TargetEncoder | None = None,
) -> DeployedPolicy:
    """Return the policy, ready to be started; latents, if any, come from ψ^t, or without it from ψ^s."""
    world = trained.simulation.world if trained.simulation else EnvConfig()
    return DeployedPolicy(
        task,
        trained.policy,
        grounding.encoder,
        target_encoder,
        command_limit_m_s=world.command_limit_m_s,
        observed=trained.observed,
    )
