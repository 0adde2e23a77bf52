"""On a real Ray cluster of two nodes, both of this machine."""

import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from fake_items import Record, crash, fail, hang, kill_itself, rendezvous, touch

from astra_data.core.errors import AstraDataError, BadInputError, MissingStageError
from astra_data.pipeline.executors import SETTINGS, Item, execute_on_cluster

os.environ |= SETTINGS  # Ray looks when it is imported
ray = pytest.importorskip("ray", reason="ray is not installed: uv sync --extra ray")


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    from ray.cluster_utils import Cluster  # noqa: PLC0415 - only where Ray is installed

    node = {"num_cpus": 1, "num_gpus": 0, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=node)
    cluster.add_node(num_cpus=1, num_gpus=0)
    yield cluster.address
    cluster.shutdown()


def test_items_run_on_both_nodes_as_soon_as_their_inputs_are_finished(address: str, tmp_path: Path) -> None:
    one, two, last = (tmp_path / name for name in ("one", "two", "last"))
    items = [
        Item("c/last", ("a/one", "b/two"), partial(touch, last, (one, two))),
        Item("a/one", ("not/planned",), partial(rendezvous, one, two)),
        Item("b/two", (), partial(rendezvous, two, one)),
    ]
    record = Record()
    execute_on_cluster(items, address=address, jobs=None, logs=tmp_path / "logs", watch=record)
    assert record.events[-3:] == [(event, "c/last") for event in ("started", "0.5 half", "finished")]
    assert not [path for path in (tmp_path / "logs").rglob("*") if path.is_file()]


def test_failures_come_back_and_stop_the_others(address: str, tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    items = [
        Item("hang", (), partial(hang, pid_file)),
        Item("wait", (), partial(rendezvous, tmp_path / "mine", pid_file)),
        Item("a/fail", ("wait",), fail),
    ]
    record = Record()
    with pytest.raises(MissingStageError, match=r"^a/fail: nothing to eat$"):
        execute_on_cluster(items, address=address, jobs=None, logs=tmp_path, watch=record)
    assert record.events[-1] == ("failed", "a/fail")
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid_file.read_text()), 0)

    with pytest.raises(AstraDataError, match=r"^a/b crashed: ValueError: a bug \(traceback: .*b\.txt\)$"):
        execute_on_cluster([Item("a/b", (), crash)], address=address, jobs=1, logs=tmp_path, watch=Record())
    log = (tmp_path / "a/b.txt").read_text()
    assert "about to crash" in log and "Traceback" in log

    lost = [Item("a", (), kill_itself)]
    with pytest.raises(AstraDataError, match=r"^a was lost with its worker: "):
        execute_on_cluster(lost, address=address, jobs=1, logs=tmp_path, watch=Record())


def test_a_cluster_that_does_not_answer_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise ConnectionError("nobody there\nat all")

    monkeypatch.setattr("ray.init", refuse)
    with pytest.raises(BadInputError, match=r"^found no usable Ray cluster at head:1: nobody there; `ray"):
        execute_on_cluster([], address="head:1", jobs=None, logs=tmp_path, watch=Record())


def test_a_worker_that_does_not_share_the_folder_is_told(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = SimpleNamespace(cwd=lambda: tmp_path / "elsewhere")
    monkeypatch.setattr("astra_data.pipeline.executors.Path", own)
    record = Record()
    items = [Item("a", (), partial(touch, tmp_path / "a", ()))]
    with pytest.raises(
        AstraDataError, match=r"^a: .* cannot use .*elsewhere, which .* must share: No such file or directory$"
    ):
        execute_on_cluster(items, address=address, jobs=None, logs=tmp_path / "logs", watch=record)
    assert record.events == [("failed", "a")]


def test_a_gpu_that_is_not_there_is_told_at_once(address: str, tmp_path: Path) -> None:
    items = [
        Item("a", (), partial(touch, tmp_path / "a", ())),
        Item("b", ("a",), partial(touch, tmp_path / "b", ()), device="cuda"),
    ]
    with pytest.raises(BadInputError, match=r"^the Ray cluster at .* has no GPU: use --device cpu$"):
        execute_on_cluster(items, address=address, jobs=None, logs=tmp_path / "logs", watch=Record())
    assert not (tmp_path / "a").exists()


def test_a_cluster_that_is_lost_is_told(address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lose(*_: object, **__: object) -> None:
        raise ray.exceptions.RaySystemError("gone\nfor good")

    monkeypatch.setattr("ray.wait", lose)
    monkeypatch.setattr("ray.cancel", lose)
    items = [Item("a", (), partial(touch, tmp_path / "a", ()))]
    with pytest.raises(AstraDataError, match=r"^the Ray cluster at .* was lost: .*gone$"):
        execute_on_cluster(items, address=address, jobs=None, logs=tmp_path / "logs", watch=Record())
