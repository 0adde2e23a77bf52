import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from astra_data.core.errors import BadInputError
from astra_data.grounding.descent import Descent, DescentConfig, WindowedConfig, seeded

CONFIG = DescentConfig(updates=40, learning_rate=0.05)


def model() -> nn.Linear:
    torch.manual_seed(0)
    return nn.Linear(3, 2)


def loss_of(one: nn.Module, update: int) -> Tensor:
    torch.manual_seed(100 + update)
    seen = torch.randn(16, 3)
    return torch.as_tensor((one(seen) - 4.0 * seen[:, :2]).square().mean())


def fit(one: nn.Linear, descent: Descent, until: int = CONFIG.updates) -> nn.Linear:
    while descent.done < until:
        descent.update(loss_of(one, descent.done))
    return one


def test_it_is_adamw_down_a_half_cosine_with_clipped_gradients() -> None:
    ours, theirs = model(), model()
    fit(ours, descent := Descent(ours, CONFIG, weight_decay=0.1))
    ours.bias.requires_grad_(False)
    assert len(descent.parameters) == 2 and len(Descent(ours, CONFIG).parameters) == 1
    optimizer = torch.optim.AdamW(theirs.parameters(), lr=0.05, weight_decay=0.1)
    for update in range(40):
        for group in optimizer.param_groups:
            group["lr"] = 0.05 * (1 + math.cos(math.pi * update / 40)) / 2
        gradients = torch.autograd.grad(loss_of(theirs, update), list(theirs.parameters()))
        norm = torch.cat([gradient.flatten() for gradient in gradients]).norm()
        for parameter, gradient in zip(theirs.parameters(), gradients, strict=True):
            parameter.grad = gradient / norm.clamp_min(1.0)
        optimizer.step()
    torch.testing.assert_close(ours.weight, theirs.weight, rtol=1e-4, atol=1e-5)


def test_a_fit_that_diverged_ends_before_it_is_kept(tmp_path: Path) -> None:
    one = model()
    checkpoint = tmp_path / "checkpoint.safetensors"
    descent = Descent(one, CONFIG, checkpoint=checkpoint)
    fit(one, descent, until=2)
    advice = "make learning_rate smaller"
    with pytest.raises(BadInputError, match=f"diverged by update 2, with a loss that is not finite: {advice}"):
        descent.keep(1.0, loss=float("nan"))
    with pytest.raises(BadInputError, match=rf"diverged in update 3, with a gradient .*: {advice}"):
        descent.update(one.weight.sum() * float("inf"))
    assert not checkpoint.exists() and bool(one.weight.isfinite().all())


def test_from_a_checkpoint_it_goes_on_to_the_bit(tmp_path: Path) -> None:
    whole, begun, resumed = model(), model(), model()
    fit(whole, Descent(whole, CONFIG))
    checkpoint = tmp_path / "checkpoint.safetensors"
    first = Descent(begun, CONFIG, checkpoint=checkpoint)
    fit(begun, first, until=15)
    first.keep(loss=0.25, nothing=None)
    second = Descent(resumed, CONFIG, checkpoint=checkpoint)
    assert (second.done, second.share, second.is_over) == (15, 15 / 40, False)
    assert second.points == [{"step": 15, "loss": 0.25, "nothing": None}] and second.stopwatch.seconds > 0
    fit(resumed, second)
    assert second.is_over and torch.equal(resumed.weight, whole.weight)


@pytest.mark.parametrize("stopped", [None, 4, 8, 12])
@pytest.mark.parametrize(
    ("errors", "best", "last"),
    [
        ([3.0, 2.0, 2.5, 2.1, 2.0, 1.9, 1.0], 8, 21),  # as low as before is no better
        ([5.0, 4.0, 3.0, 4.0, 3.5, 2.9, 2.9, 2.8, 3.0, 2.95], 32, 40),
        ([9.0, 9.5, 9.5, 9.5, 1.0], 4, 17),
    ],
)
def test_it_waits_for_a_lower_error_and_returns_to_the_lowest(
    errors: list[float], best: int, last: int, stopped: int | None, tmp_path: Path
) -> None:
    """Every fourth of 40 updates is measured, and 12 without a lower error are as many as it waits."""
    checkpoint, one = tmp_path / "checkpoint.safetensors", model()
    descent, seen = Descent(one, CONFIG, checkpoint=checkpoint), dict[int, Tensor]()
    while not descent.is_over:
        descent.update(loss_of(one, descent.done))
        if descent.done % 4 == 0:
            descent.keep(errors[descent.done // 4 - 1])
            seen[descent.done] = one.weight.detach().clone()
        if descent.done == stopped:
            one = nn.Linear(3, 2)
            descent = Descent(one, CONFIG, checkpoint=checkpoint)
    assert (descent.best, descent.done) == (best, last) and not torch.equal(one.weight, seen[best])
    descent.finish()
    assert torch.equal(one.weight, seen[best])


@pytest.mark.parametrize(
    ("steps", "updates", "expected"), [(100, None, 600), (60_000, None, 800), (10**6, None, 1200), (60_000, 7, 7)]
)
def test_each_recorded_step_is_seen_32_times_unless_updates_are_given(
    steps: int, updates: int | None, expected: int
) -> None:
    """60 000 * 32 are 800 updates of 48 windows of 50 steps."""
    assert WindowedConfig(updates=updates).descent(steps) == DescentConfig(updates=expected, learning_rate=3e-3)


CPU, GPU = torch.device("cpu"), torch.device("cuda:1")


@pytest.fixture
def on_gpus(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Note what is asked of a CUDA device that is not there."""
    noted: list[object] = []

    @contextmanager
    def device(asked: torch.device) -> Iterator[None]:
        noted.append(asked)
        yield

    monkeypatch.setattr(torch.cuda, "device", device)
    for name in ("manual_seed", "manual_seed_all", "get_rng_state"):
        monkeypatch.setattr(torch.cuda, name, noted.append)
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda state, device: noted.append((state, device)))
    return noted


def test_in_a_block_draws_are_from_its_seed_and_go_on_afterwards() -> None:
    torch.manual_seed(1)
    first, second = torch.rand(5), torch.rand(5)
    torch.manual_seed(1)
    assert torch.equal(torch.rand(5), first)
    with seeded(1, CPU):
        assert torch.equal(torch.rand(5), first)
    assert torch.equal(torch.rand(5), second)


def test_the_generator_of_the_device_in_use_is_seeded_and_put_back(on_gpus: list[object]) -> None:
    with seeded(3, GPU):
        assert on_gpus == [GPU, GPU, 3]
    assert on_gpus[3:] == [(None, GPU)]
