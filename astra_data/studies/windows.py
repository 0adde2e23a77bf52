"""Models on a window of the last H steps: ridge regression, and a feed-forward network."""

import torch
from torch import Tensor, nn

from astra_data.learning.networks.history import mlp
from astra_data.studies.predictors import Predictor, bounded
from astra_data.studies.walks import Stretch


class WindowModel(Predictor):
    """Corrects the simulator's motion from the last H motions and actions, the ball, and that motion itself.

    Without hidden layers it is linear. Scales are buffers, so they are saved with the weights.
    """

    def __init__(self, history: int, hidden_sizes: tuple[int, ...] = ()) -> None:
        super().__init__()
        self.history = history
        self.network = mlp((7 * history + 9, *hidden_sizes, 3))
        # Before fitting it is the raw simulator.
        for parameter in self.network[-1].parameters():
            nn.init.zeros_(parameter)
        for name in ("motion_mean", "motion_std", "correction_std"):
            self.register_buffer(name, torch.ones(3))
        self.motion_mean: Tensor
        self.motion_std: Tensor
        self.correction_std: Tensor

    def set_scales(self, stretch: Stretch) -> None:
        """Set the scales from the future steps of walking."""
        motion, simulated = (values[stretch.is_walking] for values in (stretch.motion, stretch.simulated))
        self.motion_std.copy_(motion.std(0))
        # Sideways and in turn a mean other than zero is an accident of the recordings.
        self.motion_mean.copy_(motion.mean(0) * motion.new_tensor([1.0, 0.0, 0.0]))
        self.correction_std.copy_((motion - simulated).std(0))

    def inputs(self, memory: Tensor, ball: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the network's inputs, (B, 7 H + 9)."""
        past, past_action = memory.view(len(memory), self.history, 7).split((3, 4), dim=-1)
        seen = [self._normal(past).flatten(1), past_action.flatten(1), action, bounded(ball)]
        return torch.cat([*seen, self._normal(simulated)], dim=-1)

    def begin(self, stretch: Stretch) -> Tensor:
        """Return the window of past motions and actions, (B, 7 H)."""
        return torch.cat([stretch.past_motion, stretch.past_action], dim=-1).flatten(1)

    def motion(self, memory: Tensor, ball: Tensor, action: Tensor, simulated: Tensor) -> Tensor:
        """Return the corrected motion."""
        correction: Tensor = self.network(self.inputs(memory, ball, action, simulated))
        return simulated + self.correction_std * correction

    def after(self, memory: Tensor, motion: Tensor, ball: Tensor, action: Tensor) -> Tensor:
        """Return the window moved on by one step."""
        return torch.cat([memory[:, 7:], motion, action], dim=-1)

    def solve(self, stretch: Stretch, strength: float) -> None:
        """Solve ridge regression of the first step's correction; the penalty is `strength` times the samples.

        Only for a model without hidden layers.
        """
        step = (stretch.past_ball[:, -1], stretch.action[:, 0], stretch.simulated[:, 0])
        inputs = self.inputs(self.begin(stretch), *step).double()
        target = ((stretch.motion - stretch.simulated)[:, 0] / self.correction_std).double()
        inputs = torch.cat([inputs, torch.ones_like(inputs[:, :1])], dim=1)
        penalty = strength * len(inputs) * torch.ones(inputs.shape[1], dtype=torch.float64)
        penalty[-1] = 0.0
        solution = torch.linalg.solve(inputs.T @ inputs + penalty.diag(), inputs.T @ target)
        weight, bias = self.network.parameters()
        with torch.no_grad():
            weight.copy_(solution[:-1].T)
            bias.copy_(solution[-1])

    def _normal(self, motion: Tensor) -> Tensor:
        return (motion - self.motion_mean) / self.motion_std
