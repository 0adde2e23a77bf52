import hashlib
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_dataset import write_fake
from toy_logs import write_logs

from astra_data.core.errors import BadInputError
from astra_data.dataset import columns as keys
from astra_data.dataset.reader import Dataset
from astra_data.pipeline.stages.pair import PairConfig, pair, pair_steps
from astra_data.robots.registry import TASKS, pairing_named

_PLANAR = [0, 1, 15, 16]
"""x, y, vx and vy in an ant's qpos (15) and qvel (14)."""
MINE = Path(__file__).parents[2] / "my_simulator.py"
PAIR = (keys.ABSTRACT_STATE, keys.ABSTRACT_NEXT_STATE, keys.ABSTRACT_SIMULATED_NEXT_STATE)


def test_the_simulator_starts_where_the_target_was_and_takes_its_action(paired: Path) -> None:
    columns = Dataset.open(paired).columns([keys.STATE, keys.ACTION, keys.NEXT_STATE, *PAIR])
    np.testing.assert_array_equal(columns[keys.ABSTRACT_STATE], columns[keys.STATE][:, _PLANAR])
    np.testing.assert_array_equal(columns[keys.ABSTRACT_NEXT_STATE], columns[keys.NEXT_STATE][:, _PLANAR])
    position = columns[keys.STATE][:, :2].astype(np.float64)
    landed = columns[keys.ABSTRACT_SIMULATED_NEXT_STATE]
    free = TASKS["antmaze-umaze"].maze.clearance(position) > 0.4
    assert free.sum() > 100
    np.testing.assert_allclose(landed[free, :2], (position + 0.05 * columns[keys.ACTION])[free], atol=1e-5)
    np.testing.assert_allclose(landed[free, 2:], columns[keys.ACTION][free], atol=1e-4)


def test_all_else_stays_and_the_parent_is_recorded(collected: Path, paired: Path) -> None:
    before, after = Dataset.open(collected), Dataset.open(paired)
    assert after.description["parents"] == [before.identity]
    assert after.reference == before.reference.replace("1.0.0", "2.0.0") and after.description["reset_error"] == 0.0
    numbers = {"timestep_s": 0.05, "radius_m": 0.1, "speed_m_s": 1.0}
    assert after.description["simulator"] == {"id": "point_mass", "task": "antmaze-short", **numbers}
    assert after.description["machine"] == before.description["machine"] and after.order == before.order
    assert after.metadata == before.metadata
    for one, other in zip(before.episodes(), after.episodes(), strict=True):
        assert one.uid == other.uid
        for name, values in one.columns.items():
            np.testing.assert_array_equal(values, other.columns[name])


def test_abstract_columns_have_units_frames_and_roles(paired: Path) -> None:
    features = Dataset.open(paired).features
    meanings = set()
    for name in PAIR:
        astra = features[name]["astra"]
        meanings.add(astra["meaning"])
        assert features[name]["names"] == ["x", "y", "vx", "vy"]
        for key in ("unit", "frame", "role"):  # as in the target's columns
            assert astra[key] == [features[keys.STATE]["astra"][key][index] for index in _PLANAR]
    assert len(meanings) == 3


def test_many_simulators_give_what_one_gives(collected: Path) -> None:
    columns = Dataset.open(collected).columns([keys.STATE, keys.ACTION, keys.NEXT_STATE])
    steps = [values[:25] for values in columns.values()]
    pairing = pairing_named("antmaze-umaze")
    wide, _ = pair_steps(pairing, pairing.simulator(64), *steps, tolerance=0.0)
    for size in (1, 7, 25):
        narrow, error = pair_steps(pairing, pairing.simulator(size), *steps, tolerance=0.0)
        assert error == 0.0
        for name, values in wide.items():
            np.testing.assert_array_equal(narrow[name], values)


def test_a_simulator_of_your_own(collected: Path, tmp_path: Path) -> None:
    pair(f"{MINE}:Glider", dataset=collected, out=tmp_path / "out")
    dataset = Dataset.open(tmp_path / "out")
    digest = hashlib.sha256(MINE.read_bytes()).hexdigest()
    assert dataset.description["simulator"] == {"id": "Glider", "file_sha256": digest, "timestep_s": 0.05}
    assert dataset.features[keys.ABSTRACT_STATE]["names"] == ["x", "y"]
    columns = dataset.columns([keys.STATE, keys.ACTION, keys.ABSTRACT_SIMULATED_NEXT_STATE])
    expected = columns[keys.STATE][:, :2] + np.float32(0.05) * columns[keys.ACTION]
    np.testing.assert_array_equal(columns[keys.ABSTRACT_SIMULATED_NEXT_STATE], expected)


def glider(place: Path, name: str, *body: str) -> str:
    """Write a simulator that is Glider but for the lines of `body`."""
    first = f"import sys\nsys.path.insert(0, {str(MINE.parent)!r})\nfrom my_simulator import Glider"
    (place / f"{name}.py").write_text("\n    ".join([f"{first}\nclass {name}(Glider):", *body]))
    return f"{place}/{name}.py:{name}"


def glider_that_is_off(place: Path, error: float, later: str) -> str:
    """Write a simulator that is reset with an error, and at each time after with that which `later` gives."""
    reset = f"super().reset_to(state + self.error, rows); self.error = {later}"
    return glider(place, "Off", f"error = {error}", f"def reset_to(self, state, rows=None): {reset}")


@pytest.mark.parametrize("size", ["_BLOCK", "BATCH"])
def test_the_largest_reset_error_of_all_blocks_is_recorded(
    size: str, collected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A block for each of the eight episodes, or all in one and a batch for each ten steps.
    monkeypatch.setattr(f"astra_data.pipeline.stages.pair.{size}", {"_BLOCK": 1, "BATCH": 10}[size])
    config = PairConfig(reset_tolerance=0.1)
    simulator = glider_that_is_off(tmp_path, 0.08, "self.error / 2")
    pair(simulator, config, dataset=collected, out=tmp_path / "out")
    assert Dataset.open(tmp_path / "out").description["reset_error"] == pytest.approx(0.08, abs=1e-5)


@pytest.mark.parametrize(
    ("simulator", "told"),
    [
        (f"{MINE}:Forgetful", r"reset to φ\(s\) of step \d+, has [xy] = .*, expected .*: check its reset_to"),
        (f"{MINE}:Exploding", r"stepped from φ\(s\) of step 0, gives x = .*: expected finite states"),
        (f"{MINE}:Greedy", r"abstraction of Greedy, given states \(\d+, 29\), fails with IndexError"),
        (f"{MINE}:Clumsy", r"Clumsy\(4096\) fails with TypeError"),
        (f"{MINE}:Narrow", r"Narrow\(4096\).state: expected shape \(4096, 2\), got \(4096, 1\)"),
        (f"{MINE}:Bare", r"Bare.parameters: expected numbers or texts for maze"),
        (f"{MINE}:Squeezing", r"step of Squeezing returns shape \(4096, 1\), expected \(4096, 2\)"),
        ("antmaze-long", r"was collected for antmaze-short, which has another maze .*: give --simulator"),
        (f"{MINE}:Numeric", r"Numeric\(4096\).state: expected a torch tensor, got a ndarray"),
        (f"{MINE}:Relapsing", r"after reset_to, Relapsing.state: expected a torch tensor, got a ndarray"),
        (f"{MINE}:Wide", r"abstraction of Wide makes \(\d+, 3\) of states .* expected \(\d+, 2\)"),
        (f"{MINE}:Gilder", r"has no 'Gilder'; it has .*Glider"),
    ],
)
def test_a_simulator_that_does_not_fit_is_refused(
    task: str, collected: Path, tmp_path: Path, simulator: str, told: str
) -> None:
    with pytest.raises(BadInputError, match=told) as caught:
        pair(simulator, dataset=collected, out=tmp_path / "out")
    assert "\n" not in str(caught.value) and list(tmp_path.iterdir()) == []


def test_data_of_another_rate_are_refused(collected: Path, tmp_path: Path) -> None:
    source = Dataset.open(collected)
    description = {"name": "slow", "stage": "import", "environment": source.description["environment"]}
    slow = tmp_path / "slow"
    write_fake(slow, [next(source.episodes())], columns=source.schema, fps=10, description=description)
    told = r"slow has 10 steps per second, where point_mass makes 20; expected a dataset to be paired"
    with pytest.raises(BadInputError, match=told):
        pair("antmaze-umaze", dataset=slow, out=tmp_path / "out")
    pair(f"{MINE}:Glider", dataset=slow, out=tmp_path / "out")  # of no task, and of no rate


def rewritten(source: Dataset, out: Path, changed: dict[str, keys.Column]) -> Path:
    """Write the first episode of a dataset with some columns called, and cut, as `changed` has them."""
    columns = [changed.get(column.name, column) for column in source.schema]
    description = {"name": "other", "stage": "import", "environment": source.description["environment"]}
    episode = next(source.episodes())
    cut = {name: episode.columns[name][:, : column.size] for name, column in changed.items()}
    other = replace(episode, columns={**episode.columns, **cut})
    return write_fake(out, [other], columns=columns, description=description).root


def test_bounds_of_the_commands_are_recorded(tmp_path: Path) -> None:
    """They say what the commands are multiples of to whoever learns from the pairs."""
    columns = [keys.Column(keys.STATE, size=2), keys.Column(keys.NEXT_STATE, size=2), keys.Column(keys.ACTION, size=1)]
    still = np.zeros((3, 2), np.float32)
    episode = keys.Episode(0, {keys.STATE: still, keys.NEXT_STATE: still, keys.ACTION: still[:, 0]}, {})
    write_fake(tmp_path / "logs", [episode], columns=columns, fps=10)
    cart = f"{MINE.with_name('small_cart.py')}:TASK"
    out = pair(cart, dataset=tmp_path / "logs", out=tmp_path / "out")
    assert Dataset.open(out).description["simulator"]["commands"] == {"v": [-1.0, 4.0]}


@pytest.mark.usefixtures("task")  # known, and in the maze of the task that the simulator is of
def test_names_that_are_not_the_tasks_are_told(
    collected: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    action = next(column for column in Dataset.open(collected).schema if column.name == keys.ACTION)
    other = replace(action, names=("left", "right"))
    source = rewritten(Dataset.open(collected), tmp_path / "other", {keys.ACTION: other})
    pair("antmaze-umaze", dataset=source, out=tmp_path / "out")
    assert "takes left, right of action as " in caplog.text


def test_data_of_another_robot_are_refused(collected: Path, tmp_path: Path) -> None:
    changed = {name: keys.Column(name, size=2) for name in (keys.STATE, keys.NEXT_STATE)}
    other = rewritten(Dataset.open(collected), tmp_path / "other", changed)
    with pytest.raises(BadInputError, match=r"observation.state has 2 values, expected those of antmaze-umaze: "):
        pair("antmaze-umaze", dataset=other, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_paired_dataset_is_not_paired_again(paired: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"has abstract.state already: it is paired"):
        pair("antmaze-umaze", dataset=paired, out=tmp_path / "out")


@pytest.mark.usefixtures("task")
@pytest.mark.parametrize("removed", PAIR)
def test_of_which_a_column_was_removed_it_is(paired: Path, tmp_path: Path, removed: str) -> None:
    whole, at = Dataset.open(paired), tmp_path / "left"
    left = [column for column in whole.schema if column.name != removed]
    kept = (replace(one, columns={c.name: one.columns[c.name] for c in left}) for one in whole.episodes())
    description = {"name": "left", "stage": "import", "environment": whole.description["environment"]}
    part = write_fake(at, kept, columns=left, description=description)
    again = Dataset.open(pair("antmaze-umaze", dataset=at, out=tmp_path / "out"))
    assert again.content_hash == whole.content_hash and again.reference == "left@data-2.0.0"
    assert again.description["parents"] == [part.identity]


def test_the_step_that_is_told_is_that_of_the_dataset(
    collected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A simulator that is reset rightly once, for the first episode, and never again, or lost."""
    monkeypatch.setattr("astra_data.pipeline.stages.pair._BLOCK", 1)
    simulator, out = glider_that_is_off(tmp_path, 0.0, "0.5"), tmp_path / "out"
    with pytest.raises(BadInputError) as caught:
        pair(simulator, dataset=collected, out=out)
    told = re.search(r"of step (\d+), has ([xy]) = .*, expected (\S+) \(", str(caught.value))
    assert told is not None
    source, step, entry = Dataset.open(collected), int(told[1]), "xy".index(told[2])
    assert source.lengths[0] <= step < source.lengths[:2].sum()
    assert float(told[3]) == pytest.approx(source.columns([keys.STATE])[keys.STATE][step, entry], rel=1e-5)
    lost = f"stepped from φ(s) of step {source.lengths[0] + 3}, gives y = "  # in the fourth row of the second step
    loses = "self.steps += 1; super().step(action)[3, 1] /= float(self.steps < 2); return self.state"
    with pytest.raises(BadInputError, match=re.escape(lost)):
        pair(glider(tmp_path, "Lost", "steps = 0", f"def step(self, action): {loses}"), dataset=collected, out=out)


@pytest.mark.parametrize(("unit", "half"), [("rad", "π"), ("", "π"), ("deg", "180°"), ("1", "180°")])
def test_a_heading_that_wraps_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, unit: str, half: str
) -> None:
    scale, units = 57.29578 if half == "180°" else 1.0, f", astra={{'unit': ('m', '{unit}')}}" if unit else ""
    monkeypatch.setattr("astra_data.pipeline.stages.pair._BLOCK", 1)
    (tmp_path / "cart.py").write_text(
        "import torch\nfrom astra_data import Column\n"
        "class Turning:\n"
        f"    abstract_state = Column('abstract.state', size=2, names=('x', 'yaw'){units})\n"
        "    parameters = {}\n"
        "    def __init__(self, num_envs): self.state = torch.zeros(num_envs, 2)\n"
        "    def abstraction(state):\n"
        "        abstract = state[..., [0, 2]]\n"
        f"        abstract[..., 1] = {scale} * abstract[..., 1] - {180 * (scale > 1)}\n"
        "        return abstract\n"
        "    def reset_to(self, state, rows=None): self.state = state.clone()\n"
        "    def step(self, command):\n"
        f"        self.state = self.state + command[:, [0, 1]] * torch.tensor([100.0, {0.05 * scale}])\n"
        "        return self.state\n"
    )
    logs = write_logs(tmp_path / "logs")
    yaw, turned = (logs.columns([name])[name][:, 2] for name in (keys.STATE, keys.NEXT_STATE))
    wraps = int((np.abs(turned - yaw) > 6).sum())
    assert wraps > 3
    pair(f"{tmp_path}/cart.py:Turning", dataset=logs.root, out=tmp_path / "out")
    (told,) = [record.getMessage() for record in caplog.records if "φ" in record.getMessage()]
    assert told == (
        f"Turning lands more than {half} from where the robot was: yaw in {wraps} of 3000 rows; "
        "a heading that wraps: make cos and sin of it in φ"
    )
