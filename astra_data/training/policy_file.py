"""Policies on disk: one safetensors file with the networks and how to put them to work."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from astra_data.core.checkpoint import save_tensors, understood
from astra_data.grounding.grounding_file import Grounding
from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.learning.networks.adaptation import AdaptiveShape, Student
from astra_data.learning.networks.alignment import TargetEncoder
from astra_data.learning.networks.grounding import GroundingModel
from astra_data.learning.networks.policy import Policy, PolicyShape
from astra_data.learning.networks.soft_actor import SoftActor
from astra_data.training.build_env import WorldConfig
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
        world: the switches of the training world.
        variation: of the simulator's parameters from episode to episode.
    """

    thinness: Tensor | None
    scatter: Tensor
    world: WorldConfig
    variation: Variation | None = None


@dataclass(frozen=True)
class PolicyFile:
    """A trained policy.

    Attributes:
        policy: the networks.
        simulation: where it was trained; None for a policy trained in the target or on data alone.
        dataset, content_hash: the dataset that everything was learned from; None for one that was learned
            from none, to collect one.
        observed: what it is shown of the target.
    """

    policy: Policy
    simulation: Simulation | None
    dataset: str | None
    content_hash: str | None
    observed: Observed = "abstract"

    def save(self, path: Path) -> None:
        """Write the policy to `path`."""
        tensors = {f"policy.{name}": tensor for name, tensor in self.policy.state_dict().items()}
        told: dict[str, Any] = {
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
            told["simulation"] = {
                "world": self.simulation.world.model_dump(mode="json"),
                "variation": variation.model_dump() if variation else None,
            }
        save_tensors(path, tensors, told)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> "PolicyFile":
        """Read a policy; its parameters are frozen.

        Raises:
            BadInputError: it is something else, or from an older version.
        """
        with understood(path, "a policy", _KINDS, device) as (tensors, told):
            shape = told["shape"] | {"hidden_sizes": tuple(told["shape"]["hidden_sizes"])}
            made, shaped = _KINDS[told["kind"]]
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
            if said := told.get("simulation"):
                varied = said["variation"]
                simulation = Simulation(
                    tensors.get("thinness"),
                    tensors["scatter"],
                    WorldConfig(**said["world"]),
                    Variation.of_json(varied) if varied else None,
                )
            read = cls(policy, simulation, told["dataset"], told["hash"], told["observed"])
        policy.to(device).requires_grad_(False)
        return read


def deploy(
    task: Task,
    trained: PolicyFile,
    grounding: Grounding | None = None,
    target_encoder: TargetEncoder | None = None,
) -> DeployedPolicy:
    """Return the policy, ready to be started; its latents, if any, come from ψ^t, or from ψ^s without one."""
    world = trained.simulation.world if trained.simulation else WorldConfig()
    return DeployedPolicy(
        task,
        trained.policy,
        grounding if isinstance(grounding, GroundingModel) else None,
        target_encoder,
        command_limit_m_s=world.command_limit_m_s,
        observed=trained.observed,
    )
