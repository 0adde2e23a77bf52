"""Run the policy in this folder: onnxruntime and NumPy alone. `python run_policy.py` tries it."""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

HERE = Path(__file__).parent
FAR = 5.0  # how far beyond the recorded range a state may be, in widths of it: values in another unit are farther


class RobotPolicy:
    """The policy, for one robot: `start` an episode, then `act` once every control period."""

    def __init__(
        self, *, rate_hz: float, state: Sequence[str], goal: Sequence[str] = (), folder: str | Path = HERE
    ) -> None:
        """Take the rate at which it will act, and the names of the values that it will be given."""
        described, graph = intact(folder, "policy.json", "policy.onnx")
        self.about: dict[str, Any] = json.loads(described)
        if not abs(finite("rate_hz", [rate_hz], ["rate_hz"])[0] / self.about["rate_hz"] - 1.0) <= 0.01:
            raise ValueError(f"rate_hz: expected {self.about['rate_hz']:g}, got {rate_hz}")
        for column, names in (("state", state), ("goal", goal)):
            given = list(names) if isinstance(names, Iterable) else names
            if given != (expected := self.about[column]["names"]):
                raise ValueError(f"{column}: expected the values {expected}, got {given}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
        self.start()

    def start(self) -> None:
        """Forget the last episode."""
        self.hidden = np.zeros((1, self.about["hidden"]["size"]), np.float32)

    def act(self, state: Any, goal: Any = ()) -> Any:  # noqa: ANN401 - anything like an array
        """Return the command (A,) for a state (S,) and a goal (G,), all in the units of policy.json."""
        feed = {"hidden": self.hidden}
        for column, given in (("state", state), ("goal", goal)):
            feed[column] = finite(column, given, self.about[column]["names"])[None]
        refuse_far(feed["state"][0], self.about["state"])
        command, hidden = self.session.run(None, feed)
        if not np.isfinite(command).all():
            raise ValueError(f"the policy gives no command for the state {state!r} and the goal {goal!r}")
        self.hidden = hidden
        return command[0]


def intact(folder: str | Path, *names: str) -> list[bytes]:
    """Return what the files hold, or raise a ValueError if manifest.json has other digests of them."""
    folder = Path(folder)
    try:
        files = json.loads((folder / "manifest.json").read_bytes())["files"]
        expected = [str(files[name]["sha256"]) for name in names]
        found = [(folder / name).read_bytes() for name in names]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise ValueError(
            f"{folder}: expected {', '.join(names)} and manifest.json as astra-data deploy wrote them, got "
            f"{type(error).__name__}: {error}: copy the folder again, or deploy again"
        ) from None
    for name, digest, content in zip(names, expected, found, strict=True):
        if hashlib.sha256(content).hexdigest() != digest:
            raise ValueError(f"{folder / name} was altered: copy the folder again, or deploy again")
    return found


def refuse_far(state: Any, about: dict[str, Any]) -> None:  # noqa: ANN401 - an array
    """Raise a ValueError for a value of a state (S,) that is far outside what was recorded, if that has a width."""
    if "recorded_least" not in about:
        return
    least, largest = (np.asarray(about[f"recorded_{end}"], float) for end in ("least", "largest"))
    width = np.max([largest - least, np.abs(least), np.abs(largest)], axis=0)
    far = np.maximum(least - state, state - largest) > FAR * width
    for index in np.flatnonzero(far & (width > 0)):
        unit = f" {about['units'][index]}" if "units" in about else ""
        usual = f"recorded is {least[index]:g} to {largest[index]:g}{unit}: give it in that unit"
        raise ValueError(f"state: {about['names'][index]} is {state[index]:g}, {usual}")


def finite(called: str, given: Any, names: Sequence[str]) -> Any:  # noqa: ANN401 - anything like an array
    """Return what was `given` as an array of float32, or raise a ValueError if it is not one value a name."""
    try:
        with np.errstate(over="ignore"):
            values = np.asarray(given, np.float32)
    except (TypeError, ValueError):  # texts, rows of several lengths
        values = np.full(len(names), np.nan)
    if values.shape != (len(names),) or not np.isfinite(values).all():
        shape = "" if values.ndim == 1 else f" of the shape {values.shape}"
        shown = " ".join(f"{given!r}".split())
        raise ValueError(f"{called}: expected {len(names)} finite values {names}, got {shown}{shape}")
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
    described = json.loads(intact(HERE, "policy.json")[0])
    state, goal = described["state"], described["goal"]["names"]
    policy = RobotPolicy(rate_hz=described["rate_hz"], state=state["names"], goal=goal)
    zeros = [0.0] * len(state["names"])
    ends = [state.get(f"recorded_{end}", zeros) for end in ("least", "largest")]
    still = [0.0] * len(described["command"]["names"])
    run(policy, lambda: np.mean(ends, axis=0), print, [0.0] * len(goal), steps=10, stop=still)
