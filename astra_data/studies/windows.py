"""Models on a window of the last H steps: ridge regression, and a feed-forward network."""

import torch
from torch import Tensor, nn

from astra_data.grounding.encoder import mlp
from astra_data.studies.body import Body
from astra_data.studies.predictors import LEAST_DEVIATION, Predictor
from astra_data.studies.sequences import Stretch


class WindowModel(Predictor):
    """Corrects the simulator's motion from the last H motions and commands, what is seen, and that motion.

    Without hidden layers it is linear. With a `base` of the same history it corrects that model's motion
    instead. Scales are buffers, so they are saved with the weights.
    """

    def __init__(
        self,
        history: int,
        body: Body,
        hidden_sizes: tuple[int, ...] = (),
        base: "WindowModel | None" = None,
    ) -> None:
        super().__init__()
        self.history, self.body = history, body
        motion, given, seen = body.motion_size, body.given_size, body.seen_size
        inputs = (motion + given) * (history + 1) + seen
        self.base = base
        self.network = mlp((inputs, *hidden_sizes, motion))
        # Before fitting it is the raw simulator.
        for parameter in self.network[-1].parameters():
            nn.init.zeros_(parameter)
        for name in ("motion_mean", "motion_std", "correction_std"):
            self.register_buffer(name, torch.ones(motion))
        for name, size in (("given_std", given), ("seen_std", seen)):
            self.register_buffer(name, torch.ones(size))
        self.register_buffer("seen_mean", torch.zeros(seen))
        self.motion_mean: Tensor
        self.motion_std: Tensor
        self.correction_std: Tensor
        self.given_std: Tensor
        self.seen_mean: Tensor
        self.seen_std: Tensor

    def set_scales(self, stretch: Stretch) -> None:
        """Set the scales from the future steps that count."""
        motion, simulated = (values[stretch.counts] for values in (stretch.motion, stretch.simulated))
        self.motion_std.copy_(motion.std(0).clamp_min(LEAST_DEVIATION))
        self.motion_mean.copy_(motion.mean(0) * motion.new_tensor(self.body.usual_motion))
        self.correction_std.copy_((motion - simulated).std(0).clamp_min(LEAST_DEVIATION))
        if self.base is not None:
            self.correction_std.copy_(self.base.residuals(stretch).std(0).clamp_min(LEAST_DEVIATION))
        if self.body.is_scaled:
            seen, given, _ = stretch.first()
            if given.numel():
                self.given_std.copy_(given.std(0).clamp_min(LEAST_DEVIATION))
            self.seen_mean.copy_(seen.mean(0))
            self.seen_std.copy_(seen.std(0).clamp_min(LEAST_DEVIATION))

    def inputs(self, memory: Tensor, seen: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the network's inputs, (B, (M + G) (H + 1) + S)."""
        sizes = (self.body.motion_size, self.body.given_size)
        past, past_action = memory.view(len(memory), self.history, sum(sizes)).split(sizes, dim=-1)
        given = [(past_action / self.given_std).flatten(1), action / self.given_std]
        place = (self.body.features(seen) - self.seen_mean) / self.seen_std
        return torch.cat([self._normal(past).flatten(1), *given, place, self._normal(simulated)], dim=-1)

    def begin(self, stretch: Stretch) -> Tensor:
        """Return the window of past motions and commands, (B, (M + G) H)."""
        return torch.cat([stretch.past_motion, stretch.past_action], dim=-1).flatten(1)

    def motion(self, memory: Tensor, seen: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the corrected motion."""
        correction: Tensor = self.network(self.inputs(memory, seen, action, simulated))
        start = simulated if self.base is None else self.base.motion(memory, seen, action, simulated)
        return start + self.correction_std * correction

    def after(self, memory: Tensor, motion: Tensor, seen: Tensor, action: Tensor) -> Tensor:
        """Return the window moved on by one step."""
        return torch.cat([memory[:, motion.shape[1] + action.shape[1] :], motion, action], dim=-1)

    def solve(self, stretch: Stretch, strength: float) -> None:
        """Solve ridge regression of the first step's correction; the penalty is `strength` times the samples.

        Only for a model without hidden layers.
        """
        inputs = self.inputs(self.begin(stretch), *stretch.first()).double()
        target = ((stretch.motion - stretch.simulated)[:, 0] / self.correction_std).double()
        inputs = torch.cat([inputs, torch.ones_like(inputs[:, :1])], dim=1)
        penalty = strength * len(inputs) * torch.ones(inputs.shape[1], dtype=torch.float64)
        penalty[-1] = 0.0
        solution = torch.linalg.solve(inputs.T @ inputs + penalty.diag(), inputs.T @ target)
        weight, bias = self.network.parameters()
        with torch.no_grad():
            weight.copy_(solution[:-1].T)
            bias.copy_(solution[-1])

    def residuals(self, stretch: Stretch) -> Tensor:
        """Return what the prediction of the first step lacks, (B, M)."""
        return stretch.motion[:, 0] - self.motion(self.begin(stretch), *stretch.first())

    def _normal(self, motion: Tensor) -> Tensor:
        return (motion - self.motion_mean) / self.motion_std
