"""A policy that `astra-data deploy` wrote, as LeRobot's tools run one."""

import json
from pathlib import Path
from typing import Any, NoReturn

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import GOAL, STATE
from astra_data.deployment.folder import DESCRIPTION, TYPE
from astra_data.deployment.graph import ONNX, load_onnx
from astra_data.deployment.lerobot.configuration_astra_data import AstraDataConfig
from astra_data.deployment.run_policy import intact, refuse_far


class AstraDataPolicy(PreTrainedPolicy):  # type: ignore[misc]
    """The graph of the policy's folder, with a hidden state for each of B robots. It runs on the CPU."""

    config_class = AstraDataConfig
    name = TYPE

    def __init__(self, config: AstraDataConfig, **_: object) -> None:
        """Read the folder `config.pretrained_path`."""
        super().__init__(config)
        path = config.pretrained_path
        if path is None or not (Path(path) / DESCRIPTION).is_file():
            raise BadInputError(f"--policy.path: expected a folder that astra-data deploy wrote, got {path or 'none'}")
        try:
            described = intact(path, DESCRIPTION, ONNX)[0]
        except ValueError as error:
            raise BadInputError(str(error)) from None
        self._about: dict[str, Any] = json.loads(described)
        self._graph = load_onnx(Path(path) / ONNX)
        self.reset()

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path, *, config: AstraDataConfig | None = None, **_: object
    ) -> "AstraDataPolicy":
        """Return the policy in a folder, ready to act."""
        config = config or AstraDataConfig.from_pretrained(pretrained_name_or_path)
        config.pretrained_path = Path(pretrained_name_or_path)
        return cls(config).eval()  # type: ignore[no-any-return]

    def reset(self) -> None:
        """Forget the last episodes."""
        self._hidden: Tensor | None = None

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """Return commands (B, A), in their units, for the states (B, S) and goals (B, G) of `batch`."""
        state = self._checked(batch, STATE, "state")
        goal = self._checked(batch, GOAL, "goal") if self._about["goal"]["names"] else state[:, :0]
        if self._hidden is None:
            self._hidden = torch.zeros(len(state), self._about["hidden"]["size"])
        if not len(state) == len(goal) == len(self._hidden):
            wanted = f"expected states and goals of {len(self._hidden)} robots, as since the last reset"
            advice = "call reset() before the number of robots changes"
            raise BadInputError(f"{wanted}, got {len(state)} states and {len(goal)} goals: {advice}")
        try:
            for row in state.numpy():
                refuse_far(row, self._about["state"])
        except ValueError as error:
            raise BadInputError(str(error)) from None
        rows = [part.split(1) for part in (state, goal, self._hidden)]  # the graph is of one robot
        steps = [self._graph(*row) for row in zip(*rows, strict=True)]
        commands, hidden = zip(*steps, strict=True)
        self._hidden = torch.cat(hidden)
        return torch.cat(commands).to(batch[STATE].device)

    def predict_action_chunk(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """Return chunks (B, 1, A) of one command."""
        return self.select_action(batch).unsqueeze(1)

    def forward(self, *_: object) -> NoReturn:
        """Refuse with a NotImplementedError."""
        raise NotImplementedError("LeRobot does not train this policy: astra-data train does")

    get_optim_params = forward

    def _checked(self, batch: dict[str, Tensor], column: str, called: str) -> Tensor:
        names, given = self._about[called]["names"], batch.get(column)
        is_shaped = given is not None and given.ndim == 2 and given.shape[1] == len(names)
        if given is not None and is_shaped and given.isfinite().all():
            return given.float().cpu()
        shape = "none" if given is None else f"the shape {tuple(given.shape)}"
        came = "some that are not finite" if is_shaped else shape
        raise BadInputError(f"{column}: expected finite values (B, {len(names)}), {called} {names}, got {came}")
