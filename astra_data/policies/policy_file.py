"""Policies on disk: one safetensors file with the networks and all that is needed to run them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from astra_data.core.checkpoint import as_part, part_of, save_tensors, understood
from astra_data.core.errors import BadInputError
from astra_data.grounding.networks.alignment import TargetEncoder
from astra_data.grounding.protocols import Grounding
from astra_data.grounding.raw import NO_GROUNDING
from astra_data.policies.build_env import Simulation, WorldConfig
from astra_data.policies.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.policies.networks.adaptation import AdaptiveShape, Student
from astra_data.policies.networks.policy import Policy, PolicyShape
from astra_data.policies.networks.soft_actor import SoftActor
from astra_data.policies.own_policy import KINDS, OwnPolicy, SavedPolicy
from astra_data.policies.running_policy import Observed, RunningPolicy
from astra_data.worlds.own_saving import parts_of, restored
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation

POLICY = "policy.safetensors"
"""Name of the file of its artifact."""
_KINDS: dict[str, tuple[type[Policy], type[PolicyShape]]] = {
    "actor_critic": (ActorCritic, ActorCriticShape),
    "adaptive": (Student, AdaptiveShape),
    "soft_actor": (SoftActor, PolicyShape),
}
_PART = "policy"
"""Of the tensors of a file: the policy's networks."""


def add_policy_kind(made: type[SavedPolicy]) -> None:
    """Let files hold policies of another learner.

    Raises:
        BadInputError: the package, or another learner, has policies of this kind.
    """
    if made.kind in _KINDS or KINDS.setdefault(made.kind, made) is not made:
        raise BadInputError(
            f"policies of kind '{made.kind}' are the package's or another learner's: rename that of "
            f"{made.__name__}"
        )


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
        """Write the policy to `path`.

        Raises:
            BadInputError: it is of a class that `load` does not know, or its `to_file` returns something else
                than tensors and JSON values.
        """
        kind, networks, own = _taken_apart(self.policy)
        tensors = as_part(networks, _PART)
        metadata: dict[str, Any] = own | {
            "kind": kind,
            "shape": asdict(self.policy.shape),
            "dataset": self.dataset,
            "hash": self.content_hash,
            "observed": self.observed,
        }
        if self.simulation:
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
        with understood(Path(path), "a policy", {**_KINDS, **KINDS}, device) as (tensors, metadata):
            policy = _put_together(part_of(tensors, _PART), metadata)
            simulation = None
            if recorded := metadata.get("simulation"):
                variation = recorded["variation"]
                simulation = Simulation(
                    WorldConfig(**recorded["world"]),
                    Variation.of_json(variation) if variation else None,
                )
            read = cls(policy, simulation, metadata["dataset"], metadata["hash"], metadata["observed"])
        policy.to(device).requires_grad_(False)
        return read


def _taken_apart(policy: Policy) -> tuple[str, Mapping[str, Tensor], dict[str, Any]]:
    """Return the kind of a policy, its tensors, and metadata if it is of another learner."""
    if not isinstance(policy, OwnPolicy):
        kinds = {made: kind for kind, (made, _) in _KINDS.items()}
        if type(policy) not in kinds:
            known = ", ".join(made.__name__ for made in kinds)
            raise BadInputError(
                f"a {type(policy).__name__} cannot be read again: expected a {known}, or what an "
                "OwnLearner learns"
            )
        return kinds[type(policy)], policy.state_dict(), {}
    saved: Any = policy.acting
    tensors, metadata = parts_of(saved)
    return saved.kind, tensors, {"own": metadata}


def _put_together(tensors: dict[str, Tensor], metadata: dict[str, Any]) -> Policy:
    shape = metadata["shape"] | {"hidden_sizes": tuple(metadata["shape"]["hidden_sizes"])}
    if "own" in metadata:
        acting = restored(KINDS[metadata["kind"]], tensors, metadata["own"])
        return OwnPolicy(acting, shape["observation_size"], shape["action_size"])
    made, shaped = _KINDS[metadata["kind"]]
    policy = made(shaped(**shape))
    policy.load_state_dict(tensors)
    return policy


def running(
    task: Task,
    trained: PolicyFile,
    grounding: Grounding = NO_GROUNDING,
    target_encoder: TargetEncoder | None = None,
) -> RunningPolicy:
    """Return the policy, ready to be started; latents, if any, come from ψ^t, or without it from ψ^s.

    Raises:
        BadInputError: it is of another task, or of another grounding.
    """
    world = trained.simulation.world if trained.simulation else WorldConfig()
    made = RunningPolicy(
        task,
        trained.policy,
        grounding.encoder,
        target_encoder,
        command_limit=world.command_limit,
        observed=trained.observed,
    )
    if made.observation_size != (taken := trained.policy.shape.observation_size):
        raise BadInputError(
            f"the policy takes {taken} values, {task.name} gives {made.observation_size}: expected a "
            "policy of this task and, if it was trained in a grounded simulator, its grounding"
        )
    return made
