"""Trained policies: on robots, and in files."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from astra_data.core.checkpoint import as_part, loaded, of_json, part_of, save_tensors, understood
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch, without_gradients
from astra_data.grounding.features import encoded
from astra_data.grounding.simulator import NO_GROUNDING, Grounding, LatentEncoder
from astra_data.policies.learner import KINDS
from astra_data.policies.simulator_env import Simulation, WorldConfig, policy_observation
from astra_data.worlds.objective import NO_LIMIT
from astra_data.worlds.task import Task
from astra_data.worlds.user_code import parts_of, restored
from astra_data.worlds.variation import Variation

if TYPE_CHECKING:
    from astra_data.grounding.alignment import TargetEncoder
    from astra_data.policies.networks import Policy

Given = Tensor | NDArray[np.float32] | NDArray[np.float64]  # what measures and goals come in
Shown = Mapping[str, Given | NDArray[np.uint8]]  # in place of states: columns, or pictures, by their names

EncoderKind = Literal["target", "source"]
Observed = Literal["abstract", "full"]


def target_observation(task: Task, state: Tensor, goal: Tensor, latent: Tensor | None, observed: Observed) -> Tensor:
    """Assemble a policy's observation (..., O) of target states: that of φ(s), then, if "full", the rest."""
    abstract = policy_observation(task.objective, task.abstraction(state), goal, latent)
    return abstract if observed == "abstract" else torch.cat([abstract, task.beyond(state)], dim=-1)


class Memory(NamedTuple):
    """What B robots remember of their episodes: zeros at the start."""

    previous_output: Tensor  # what the policy put out last, (B, A)
    previous_action: Tensor  # the same as it was given to the robot, (B, A)
    policy: Tensor  # the policy's own memory, (B, ...)
    encoder: Tensor  # that of the encoder, (B, ...)


@dataclass
class RunningPolicy:
    """A policy that acts on B robots. Latents come from ψ^t on full states, or from ψ^s on φ of them.

    With `sensing`, the `inputs` of an aligned encoder take the place of states, and its estimate that of φ(s).
    """

    task: Task
    policy: "Policy"
    source_encoder: LatentEncoder | None = None  # ψ^s; None for a policy without latents
    target_encoder: LatentEncoder | None = None  # ψ^t; where it is None, ψ^s is used
    command_limit: float = NO_LIMIT  # that of the environment in which the policy was trained
    observed: Observed = "abstract"  # whether the policy observes φ of the target's state, or the full state
    sensing: "TargetEncoder | None" = None

    def __post_init__(self) -> None:
        """Check that what the encoder reads is there."""
        reads = getattr(self.target_encoder, "inputs", None)
        if reads and self.sensing is None:
            raise BadInputError(f"the target encoder reads {', '.join(reads)}, of which a task's target shows none")
        if self.sensing is not None and self.observed == "full":
            raise BadInputError(f"the policy observes full states: expected no {', '.join(self.sensing.inputs)}")

    @property
    def observation_size(self) -> int:
        """O, of what the task and the grounding give a policy to observe."""
        state = torch.zeros(1, self.task.state_columns[0].size)
        goal = torch.zeros(1, self.task.objective.goal_size)
        seen = target_observation(self.task, state, goal, None, self.observed)
        return seen.shape[1] + (self.source_encoder.encoder.latent_size if self.source_encoder else 0)

    def start(self, count: int, generator: "torch.Generator | None" = None) -> None:
        """Start B = `count` episodes without history; with `generator`, draw actions as in training."""
        still = torch.zeros(count, self.policy.shape.action_size)
        encoder = self.target_encoder or self.source_encoder
        encoded = torch.zeros(count, 0) if encoder is None else encoder.encoder.initial(count)
        self.resume(Memory(still, still, self.policy.initial_hidden(count), encoded))
        if self.sensing is not None:
            self._estimated = self.sensing.estimator.initial(count)
        self._generator = generator

    def resume(self, memory: Memory) -> None:
        """Go on with episodes from what is remembered of them, with the modes of the actions."""
        self.memory = memory
        self._generator = None

    def command(self, state: Given | Shown, goal: Given) -> Tensor:
        """Return commands (B, A), in their own units, for target states (B, S) and goals (B, G).

        A policy with `inputs` in the place of states takes these by name, (B, size) each; in place of features, it also
        takes the pictures of their camera, (B, H, W, 3) uint8.
        """
        if not hasattr(self, "memory"):
            raise BadInputError("expected start(count) before the first command")
        read = self._read(state)
        goal = self._checked("goal", goal, self.task.objective.goal_size)
        return self.task.limits.in_units(self.act(read, goal))

    def _read(self, given: Given | Shown) -> Tensor:
        """Return states (B, S), or the inputs in their place, features of pictures among them."""
        if (sensing := self.sensing) is None:
            if isinstance(given, Mapping):
                raise BadInputError("expected states, got a dict, which policies take that were aligned with `inputs`")
            return self._checked("state", given, self.task.state.size)
        shown, read = given if isinstance(given, Mapping) else {}, list[Tensor]()
        for name, size in sensing.inputs.items():
            made_by = sensing.pictures.get(name, {})
            camera = made_by.get("camera", name)
            if name not in shown and camera not in shown:
                wanted = name if camera == name else f"{name}, or pictures of {camera}"
                got = "another value" if given is not shown else ", ".join(shown) or "an empty one"
                raise BadInputError(f"this policy takes a dict in place of states: expected {wanted}, got {got}")
            values = shown[name if name in shown else camera]
            if name not in shown:
                values = encoded(np.asarray(values), made_by["encoder"], made_by.get("file_sha256", ""))
            read.append(self._checked(name, values, size))
        return torch.cat(read, dim=-1)

    def _checked(self, name: str, given: Given | NDArray[np.uint8], size: int) -> Tensor:
        values, shape = torch.as_tensor(given, dtype=torch.float32), (len(self.memory.policy), size)
        if values.shape != shape:
            raise BadInputError(f"{name}: expected the shape {shape}, got {tuple(values.shape)}")
        if not values.isfinite().all():
            row, at = (~values.isfinite()).nonzero()[0].tolist()
            raise BadInputError(f"{name}: expected finite values, got {values[row, at]:g} in row {row}, entry {at}")
        return values

    def act(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return actions (B, A), of ±1 along each axis, for target states, or inputs, (B, S) and goals (B, G)."""
        if self.sensing is not None:
            abstract = self._estimate(self.sensing, state, goal)
            if self.target_encoder is None:
                return self.act_in_simulator(abstract, goal)
            latent = self._latent(self.target_encoder, state, goal)
            return self._act(policy_observation(self.task.objective, abstract, goal, latent))
        seen = self.task.abstraction(state) if self.target_encoder is None else state
        latent = self._latent(self.target_encoder or self.source_encoder, seen, goal)
        return self._act(target_observation(self.task, state, goal, latent, self.observed))

    def act_in_simulator(self, abstract: Tensor, goal: Tensor) -> Tensor:
        """Return actions (B, A) for abstract states (B, X) and goals (B, G); latents come from ψ^s."""
        latent = self._latent(self.source_encoder, abstract, goal)
        return self._act(policy_observation(self.task.objective, abstract, goal, latent))

    @without_gradients
    def _estimate(self, sensing: "TargetEncoder", inputs: Tensor, goal: Tensor) -> Tensor:
        read = sensing.encoder_input(inputs, goal, self.memory.previous_action)
        self._estimated = sensing.estimator.step(read, self._estimated)
        return sensing.estimates(read, self._estimated)

    @without_gradients
    def _latent(self, encoder: LatentEncoder | None, seen: Tensor, goal: Tensor) -> Tensor | None:
        if encoder is None:
            return None
        inputs = encoder.encoder_input(seen, goal, self.memory.previous_action)
        hidden = encoder.encoder.step(inputs, self.memory.encoder)
        self.memory = self.memory._replace(encoder=hidden)
        return encoder.encoder.latent(hidden)

    @without_gradients
    def _act(self, observation: Tensor) -> Tensor:
        before = self.memory
        features, hidden = self.policy.remember(observation, before.previous_output, before.policy)
        output = self.policy.act(features, self._generator)
        action = self.task.objective.limit_command(output, self.command_limit)
        self.memory = Memory(output, action, hidden, before.encoder)
        return action


POLICY = "policy.safetensors"  # name of the file of its artifact
_PART = "policy"  # of the tensors of a file: the policy's networks


@dataclass(frozen=True)
class PolicyFile:
    """A trained policy."""

    policy: "Policy"
    simulation: Simulation | None  # that it was trained in; None if it was trained in the target, or on data
    dataset: str | None  # that everything was learned from; None for a policy that was trained to collect one
    content_hash: str | None  # of the dataset
    observed: Observed = "abstract"  # which part of the target's state it observes

    def save(self, path: Path) -> None:
        """Write the policy to `path`."""
        from astra_data.policies.networks import NETWORKS, UserPolicy

        policy = self.policy
        metadata: dict[str, Any] = {"shape": asdict(policy.shape), "dataset": self.dataset}
        metadata |= {"hash": self.content_hash, "observed": self.observed}
        if isinstance(policy, UserPolicy):
            saved: Any = policy.acting
            weights, metadata["own"] = parts_of(saved)
            metadata["kind"] = saved.kind
        else:
            weights, kinds = policy.state_dict(), {made: kind for kind, (made, _) in NETWORKS.items()}
            if type(policy) not in kinds:
                known = f"a {', '.join(made.__name__ for made in kinds)}, or what an UserLearner learns"
                raise BadInputError(f"a {type(policy).__name__} cannot be read again: expected {known}")
            metadata["kind"] = kinds[type(policy)]
        if self.simulation:
            world, variation = self.simulation.world, self.simulation.variation
            written = {"world": world.model_dump(mode="json"), "variation": variation and variation.model_dump()}
            metadata["simulation"] = written
        save_tensors(path, as_part(weights, _PART), metadata)

    @classmethod
    def load(cls, path: Path | str, device: str = "cpu") -> "PolicyFile":
        """Read a policy; its parameters are frozen."""
        from astra_data.policies.networks import NETWORKS, Policy, UserPolicy

        with understood(Path(path), "a policy", (*NETWORKS, *KINDS), device) as (tensors, metadata):
            weights, simulation, shape = part_of(tensors, _PART), None, metadata["shape"]
            if "own" in metadata:
                acting = restored(KINDS[metadata["kind"]], weights, metadata["own"])
                policy: Policy = UserPolicy(acting, shape["observation_size"], shape["action_size"])
            else:
                made, shaped = NETWORKS[metadata["kind"]]
                policy = loaded(made(of_json(shaped, shape)), weights, device)
            if recorded := metadata.get("simulation"):
                variation = recorded["variation"]
                simulation = Simulation(WorldConfig(**recorded["world"]), variation and Variation.of_json(variation))
            return cls(policy, simulation, metadata["dataset"], metadata["hash"], metadata["observed"])


def running(
    task: Task,
    trained: PolicyFile,
    grounding: Grounding = NO_GROUNDING,
    target_encoder: "TargetEncoder | None" = None,
    sensing: "TargetEncoder | None" = None,
) -> RunningPolicy:
    """Return the policy, ready to be started; latents, if any, come from ψ^t, or without it from ψ^s.

    What `sensing` reads and estimates takes the place of states.
    """
    limit = trained.simulation.world.command_limit if trained.simulation else NO_LIMIT
    made = RunningPolicy(task, trained.policy, grounding.encoder, target_encoder, limit, trained.observed, sensing)
    if made.observation_size != (taken := trained.policy.shape.observation_size):
        expected = "expected a policy of this task and, if it was trained in a grounded simulator, its grounding"
        raise BadInputError(f"the policy takes {taken} values, {task.name} gives {made.observation_size}: {expected}")
    return made
