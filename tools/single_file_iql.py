"""Implicit Q-learning as single-file implementations have it, to be timed."""

import copy

import torch

from astra_data.policies.iql import Experience


class SingleFileIql:
    """The method as single-file implementations have it: plain torch, an optimizer per network."""

    def __init__(self, experience: Experience) -> None:
        """Learn from the transitions of `experience`."""
        columns = ("observation", "action", "reward", "next_observation", "terminated")
        self._table = {name: getattr(experience, name).flatten(0, 1) for name in columns}
        observed, acted = experience.observation.shape[-1], experience.action.shape[-1]
        self._value = self._network(observed, 1)
        self._action_values = torch.nn.ModuleList(self._network(observed + acted, 1) for _ in range(2))
        self._targets = copy.deepcopy(self._action_values).requires_grad_(False)
        self._actor = torch.nn.Sequential(self._network(observed, acted), torch.nn.Tanh())
        self._log_std = torch.nn.Parameter(torch.zeros(acted))
        self._value_optimizer, self._action_value_optimizer, self._actor_optimizer = (
            torch.optim.Adam(parameters, lr=3e-4)
            for parameters in (
                self._value.parameters(),
                self._action_values.parameters(),
                [*self._actor.parameters(), self._log_std],
            )
        )

    @staticmethod
    def _network(inputs: int, outputs: int) -> torch.nn.Sequential:
        linear, relu = torch.nn.Linear, torch.nn.ReLU
        return torch.nn.Sequential(
            linear(inputs, 256), relu(), linear(256, 256), relu(), linear(256, outputs)
        )

    def learn(self, updates: int) -> int:
        """Make `updates` updates with batches of 256; return their number."""
        for _ in range(updates):
            rows = torch.randint(len(self._table["reward"]), (256,))
            batch = {name: values[rows] for name, values in self._table.items()}
            pair = torch.cat([batch["observation"], batch["action"]], dim=-1)
            with torch.no_grad():
                slow = torch.minimum(*(target(pair).squeeze(-1) for target in self._targets))
                following = self._value(batch["next_observation"]).squeeze(-1)
                wanted = batch["reward"] + 0.99 * following * ~batch["terminated"]
            advantage = slow - self._value(batch["observation"]).squeeze(-1)
            weight = (0.9 - (advantage < 0).float()).abs()
            self._descend(self._value_optimizer, (weight * advantage.square()).mean())
            errors = [(network(pair).squeeze(-1) - wanted).square().mean() for network in self._action_values]
            self._descend(self._action_value_optimizer, errors[0] + errors[1])
            mean = self._actor(batch["observation"])
            likelihood = (
                torch.distributions.Normal(mean, self._log_std.exp()).log_prob(batch["action"]).sum(-1)
            )
            regressed = (10.0 * advantage.detach()).exp().clamp_max(100.0) * likelihood
            self._descend(self._actor_optimizer, -regressed.mean())
            with torch.no_grad():
                for slow_one, fast in zip(
                    self._targets.parameters(), self._action_values.parameters(), strict=True
                ):
                    slow_one.lerp_(fast, 0.005)
        return updates

    @staticmethod
    def _descend(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
