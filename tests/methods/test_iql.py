import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from stopping import Stopped
from toy_episodes import toy_episodes

from astra_data.core.progress import Progress, silent
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.simulator import NO_GROUNDING
from astra_data.methods import METHODS, iql
from astra_data.methods.iql import Iql, IqlConfig, clone_behavior, experience_of, learn_from_episodes
from astra_data.policies.networks import ActorCritic, PolicyShape
from astra_data.policies.running_policy import PolicyFile
from astra_data.policies.train import PpoTrainConfig, Training
from astra_data.robots.registry import TASKS

Learn = Callable[..., tuple[PolicyFile, dict[str, Any]]]

TASK = TASKS["antmaze-umaze"]
STEPS = 30
CONFIG = IqlConfig(critic_updates=12, policy_updates=8, fine_tuning_updates=5, batch_windows=4, window=10, burn_in=2)


@pytest.fixture
def episodes() -> PairedEpisodes:
    """Return six episodes of random states; the last one is 20 steps long and ends well."""
    torch.manual_seed(0)
    state, goal = torch.randn(6, STEPS + 1, 4), torch.randn(6, 1, 2).expand(6, STEPS, 2)
    action = torch.rand(6, STEPS, 2) * 2 - 1
    mask, terminated = torch.ones(6, STEPS), torch.zeros(6, STEPS, dtype=torch.bool)
    mask[5, 20:] = 0.0
    terminated[5, 19] = True
    return toy_episodes(
        state[:, :-1],
        action,
        next_state=state[:, 1:],
        simulated_next=torch.full((6, STEPS, 4), torch.nan),
        goal=goal,
        mask=mask,
        reward=torch.randn(6, STEPS),
        terminated=terminated,
        target_state=torch.randn(6, STEPS, 29),
    )


@pytest.fixture
def given() -> PolicyFile:
    torch.manual_seed(5)
    policy = ActorCritic(PolicyShape(observation_size=8, action_size=2, memory_size=8))
    return PolicyFile(policy.requires_grad_(False), None, "toy@data-1.0.0", "abc")


@pytest.fixture
def learn(episodes: PairedEpisodes, tmp_path: Path) -> Learn:
    def learn(
        initial: PolicyFile | None = None,
        progress: Progress = silent,
        how: Learn = learn_from_episodes,
        **settings: object,
    ) -> tuple[PolicyFile, dict[str, Any]]:
        return how(
            Training(
                task=TASK,
                config=PpoTrainConfig(memory_size=8, hidden_sizes=(16,)),
                settings=CONFIG.model_copy(update=settings),
                episodes=episodes,
                grounding=NO_GROUNDING,
                initial=initial,
                seed=3,
                device="cpu",
                folder=tmp_path,
                progress=progress,
            )
        )

    return learn


def test_fine_tuning_takes_fewer_and_smaller_updates_of_the_given_policy(
    learn: Learn, given: PolicyFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    configs = list[IqlConfig]()

    class Noted(Iql):
        def __init__(self, policy: Any, experience: Any, config: IqlConfig, *, seed: int) -> None:
            configs.append(config)
            super().__init__(policy, experience, config, seed=seed)

    monkeypatch.setattr(iql, "Iql", Noted)
    before = {name: value.clone() for name, value in given.policy.state_dict().items()}
    rested, _ = learn(given, fine_tuning_updates=0)
    assert all(torch.equal(rested.policy.state_dict()[name], value) for name, value in before.items())
    (tmp_path / "checkpoint.pt").unlink()
    tuned, curve = learn(given)
    (tmp_path / "checkpoint.pt").unlink()
    learn()
    tuning, anew = configs[1:]
    assert (tuning.policy_updates, tuning.learning_rate) == (5, anew.learning_rate / 10)
    assert (anew.policy_updates, curve["points"][-1]["steps"]) == (8, 12 + 5)
    assert tuned.policy.shape == given.policy.shape
    assert not torch.equal(tuned.policy.state_dict()["actor.4.weight"], before["actor.4.weight"])
    assert all(torch.equal(given.policy.state_dict()[name], value) for name, value in before.items())
    assert METHODS["direct_transfer_iql"].initial == "direct_transfer"


def test_cloning_does_what_was_recorded_whatever_it_paid(
    learn: Learn, episodes: PairedEpisodes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("astra_data.methods.iql._CRITIC_LEARNING_RATE", 1e-2)
    # Going right pays, going left does not; both were recorded, left three times as often.
    rightwards = torch.rand(6, STEPS) < 0.25
    episodes.windows.action.copy_(torch.where(rightwards, 0.8, -0.8).unsqueeze(-1).expand(-1, -1, 2))
    episodes.windows.reward.copy_(torch.where(rightwards, 10.0, -10.0))
    settings: dict[str, Any] = {"critic_updates": 100, "return_steps": 1, "policy_updates": 150}
    settings |= {"learning_rate": 1e-2}
    seen = experience_of(TASK, episodes)
    start = torch.zeros(6, STEPS)
    mean = {}
    for how in (learn_from_episodes, clone_behavior):
        policy = learn(how=how, **settings)[0].policy
        features = policy.remember_sequence(
            seen.observation[..., :8], seen.previous_action, policy.initial_hidden(6), start
        )
        mean[how] = float(policy.act(features)[episodes.windows.mask.bool()].mean().detach())
        (tmp_path / "checkpoint.pt").unlink()
    recorded = float(episodes.windows.action[episodes.windows.mask.bool()].mean())
    assert mean[clone_behavior] == pytest.approx(recorded, abs=0.15) and mean[learn_from_episodes] > recorded + 0.3


def test_cloning_is_iql_at_temperature_zero(learn: Learn, tmp_path: Path) -> None:
    cloned = learn(how=clone_behavior)[0].policy
    (tmp_path / "checkpoint.pt").unlink()
    plain = learn(temperature=0.0, critic_updates=1)[0].policy
    assert all(map(torch.equal, cloned.parameters(), plain.parameters()))


def test_after_an_interruption_it_goes_on(
    learn: Learn, given: PolicyFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(iql, "_CHECKPOINT_EVERY", 15)
    checkpoint = tmp_path / "checkpoint.pt"
    whole, curve = learn(given)
    checkpoint.unlink()
    seen: list[float] = []

    def stop(done: float, note: str) -> None:
        raise Stopped

    with pytest.raises(Stopped):
        learn(given, stop)
    assert not checkpoint.exists()
    with pytest.raises(Stopped):
        learn(given, lambda done, note: stop(done, note) if done == 1.0 else None)
    spent = {"wall_seconds": 1000.0, "cpu_seconds": 2000.0}
    saved = torch.load(checkpoint)
    metadata = json.loads(saved["metadata"])
    assert metadata["spent"].keys() >= spent.keys()
    torch.save(saved | {"metadata": json.dumps(metadata | {"spent": metadata["spent"] | spent})}, checkpoint)
    resumed, again = learn(given, lambda done, note: seen.append(done))
    assert seen == [1.0] and again["points"] == curve["points"]
    assert all(seconds < again[clock] < seconds + 500 for clock, seconds in spent.items())
    whole.save(tmp_path / "whole")
    resumed.save(tmp_path / "resumed")
    assert (tmp_path / "whole").read_bytes() == (tmp_path / "resumed").read_bytes()
