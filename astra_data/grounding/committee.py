"""A committee of corrections, and where they disagree along commands that nobody has played yet.

Query by committee (Seung, Opper and Sompolinsky, 1992): the data that members which fit the past equally well
predict differently teaches most. As in Plan2Explore (Sekar et al., 2020), they are asked one step ahead along
a rollout that they share, not about where each would be after many: those paths part by themselves.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.core.progress import Progress, silent
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.protocols import FittedGrounding
from astra_data.learning.networks.failure import FailureModel
from astra_data.learning.networks.grounding import GroundingModel
from astra_data.worlds.protocols import WalledSimulator
from astra_data.worlds.task import Task


@dataclass(frozen=True)
class Rollouts:
    """T steps of B rollouts.

    Attributes:
        state: before each step, (T, B, X).
        information: what the step is expected to teach, in nats, if it is reached, (T, B).
        reached: how probably it is, (T, B): the episode may end before, at the goal or by a failure.
    """

    state: Tensor
    information: Tensor
    reached: Tensor

    @property
    def expected(self) -> Tensor:
        """What each step is expected to teach, in nats, (T, B)."""
        return self.information * self.reached


@dataclass(frozen=True)
class Committee:
    """All corrections of some groundings: of their models, of their members, and each head by itself.

    Attributes:
        task: the task.
        models: that correct.
        failures: the failure models, which say how probably a rollout has ended; may be none.
        covariance: of the target's scatter around the corrections, (X, X) float64.
        clearance_m: how close to walls corrections may end; None for as close as the simulator itself.
    """

    task: Task
    models: tuple[GroundingModel, ...]
    failures: tuple[FailureModel, ...]
    covariance: Tensor
    clearance_m: float | None = None

    @classmethod
    def of(cls, task: Task, groundings: Sequence[FittedGrounding]) -> Self:
        """Return the committee that `groundings` of a task make up.

        Raises:
            BadInputError: one has no history model, or there is only one correction in all.
        """
        known = [made for made in groundings if isinstance(made, HistoryGrounding)]
        if len(known) < len(groundings):
            raise BadInputError("expected groundings by history models, such as those of nas and astra")
        models = tuple(model for made in known for model in (made.model, *made.members))
        if sum(model.shape.correction_heads for model in models) < 2:
            raise BadInputError(
                "expected corrections that can disagree, got a single one: give `[ground]` members = 4, or "
                "the recipe a second seed, and run it until ground again"
            )
        # In float64 the product keeps its tiny eigenvalues, which the factor of the scatter has.
        factors = torch.stack([made.model.residual_factor for made in known]).double()
        bodies = [made.foreseeing(task.objective) if made.failures is not None else made for made in known]
        kept = [made.clearance_m for made in bodies if made.clearance_m is not None]
        return cls(
            task,
            models,
            tuple(made.failures for made in known if made.failures is not None),
            (factors @ factors.mT).mean(0),
            min(kept, default=None),
        )

    @torch.no_grad()
    def follow(self, start: Tensor, goal: Tensor, action: Tensor, progress: Progress = silent) -> Rollouts:
        """Play `action` (T, B, A) of ±1 from `start` (B, X), with goals (B, G), in the corrected simulator.

        It is corrected by the mean of the committee, without scatter.
        """
        simulator = self.task.simulator(len(start))
        if self.clearance_m is not None and isinstance(simulator, WalledSimulator):
            simulator.keep_clear(self.clearance_m)
        simulator.reset_to(start)
        objective, previous = self.task.objective, torch.zeros_like(action[0])
        reached = torch.ones(len(start))
        hidden = [start.new_zeros(len(start), model.shape.latent_size) for model in self.models]
        memories = [model.initial_memory(start, previous) for model in self.failures]
        states, information, reach = [], [], []
        for step, command in enumerate(action):
            before = simulator.state
            landed = simulator.step(command)
            hidden = [
                model.encoder.step(model.encoder_input(before, goal, previous), memory)
                for model, memory in zip(self.models, hidden, strict=True)
            ]
            predictions = torch.cat(
                [
                    model.ensemble_predictions(model.encoder.latent(memory), command, landed)
                    for model, memory in zip(self.models, hidden, strict=True)
                ]
            )
            states.append(before)
            information.append(self.information(predictions))
            reach.append(reached)
            hazards = []
            for number, model in enumerate(self.failures):
                soon, memories[number] = model.step(before, command, landed, memories[number])
                hazards.append(model.hazard(soon))
            state, previous = simulator.settle(before, predictions.mean(0)), command
            ended = objective.decided(state, goal)
            if objective.ends_at_walls:
                ended = ended | simulator.blocked
            reached = reached * ~ended
            if hazards:
                reached = reached * (1.0 - torch.stack(hazards).mean(0))
            progress((step + 1) / len(action), f"step {step + 1} of {len(action)}")
        return Rollouts(torch.stack(states), torch.stack(information), torch.stack(reach))

    def whitened(self, difference: Tensor) -> Tensor:
        """Return differences of states (..., X), float64, such that the scatter would have covariance 1."""
        apart, factor = difference.double(), torch.linalg.cholesky(self.covariance)
        white: Tensor = torch.linalg.solve_triangular(factor, apart.flatten(0, -2).T, upper=False)
        return white.T.view_as(apart)

    def information(self, predictions: Tensor) -> Tensor:
        """Return what seeing the outcome of a step would teach, (...), given predictions (K, ..., X) of it.

        That is the mutual information of outcome and member in nats, as if the members were draws of a normal
        distribution: ½ log |I + Σ⁻¹ C|, with C the covariance of the predictions and Σ that of the scatter
        (MacKay, 1992, "Information-based objective functions for active data selection").
        """
        white = self.whitened(predictions - predictions.mean(0))
        members = white.movedim(0, -2)
        identity = torch.eye(len(predictions), dtype=white.dtype)
        gram = identity + members @ members.mT / (len(predictions) - 1)
        half: Tensor = torch.linalg.cholesky(gram).diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return half.to(predictions.dtype)
