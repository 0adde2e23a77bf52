"""Run the policy in this folder: onnxruntime and NumPy alone. `python run_policy.py` tries it at rest."""

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

HERE = Path(__file__).parent


class RobotPolicy:
    """The policy, for one robot: `start` an episode, then `act` once every control period."""

    def __init__(
        self, *, rate_hz: float, state: Sequence[str], goal: Sequence[str] = (), folder: Path = HERE
    ) -> None:
        """Take the rate at which it will act, and the names of the values that it will be given."""
        self.about: dict[str, Any] = json.loads((folder / "policy.json").read_text())
        if abs(rate_hz / self.about["rate_hz"] - 1.0) > 0.01:
            raise ValueError(f"rate_hz: expected {self.about['rate_hz']:g}, got {rate_hz:g}")
        for column, names in (("state", state), ("goal", goal)):
            if list(names) != (expected := self.about[column]["names"]):
                raise ValueError(f"{column}: expected the values {expected}, got {list(names)}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(
            folder / "policy.onnx", options, providers=["CPUExecutionProvider"]
        )
        self.start()

    def start(self) -> None:
        """Forget the last episode."""
        self.hidden = np.zeros((1, self.about["hidden"]["size"]), np.float32)

    def act(self, state: Any, goal: Any = ()) -> Any:  # noqa: ANN401 - anything like an array
        """Return the command (A,) for a state (S,) and a goal (G,), all in the units of policy.json."""
        feed = {"hidden": self.hidden}
        for column, given in (("state", state), ("goal", goal)):
            feed[column] = finite(column, given, self.about[column]["names"])[None]
        command, hidden = self.session.run(None, feed)
        if not np.isfinite(command).all():
            raise ValueError(f"the policy gives no command for the state {state!r} and the goal {goal!r}")
        self.hidden = hidden
        return command[0]


def finite(called: str, given: Any, names: Sequence[str]) -> Any:  # noqa: ANN401 - anything like an array
    """Return what was `given` as an array of float32, or raise a ValueError if it is not one value a name."""
    values = np.asarray(given, np.float32)
    if values.shape != (len(names),) or not np.isfinite(values).all():
        raise ValueError(f"{called}: expected {len(names)} finite values {names}, got {given!r}")
    return values


def run(
    policy: RobotPolicy,
    measure: Callable[[], Any],
    send: Callable[[Any], None],
    goal: Sequence[float],
    steps: int,
    stop: Sequence[float] | None,
) -> None:
    """Measure the state, send the command, and wait for the next control period, `steps` times.

    The last command is `stop`, what stops the robot: also after an error, and after Ctrl-C. With None no
    other follows the policy's last, which holds a robot whose commands are positions. A period that took
    too long is not made up for: the next one begins when it ends.
    """
    last = None if stop is None else finite("stop", stop, policy.about["command"]["names"])
    policy.start()
    due = time.perf_counter()
    try:
        for _ in range(steps):
            send(policy.act(measure(), goal))
            now = time.perf_counter()
            due = max(due + 1.0 / policy.about["rate_hz"], now)
            time.sleep(due - now)
    finally:
        if last is not None:
            send(last)


if __name__ == "__main__":
    described = json.loads((HERE / "policy.json").read_text())
    state, goal = described["state"]["names"], described["goal"]["names"]
    policy = RobotPolicy(rate_hz=described["rate_hz"], state=state, goal=goal)
    still = [0.0] * len(described["command"]["names"])
    run(policy, lambda: np.zeros(len(state)), print, [0.0] * len(goal), steps=10, stop=still)
