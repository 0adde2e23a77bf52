import gymnasium
import numpy as np
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from astra_data.policies.ppo import ReturnScale


def test_rewards_are_scaled_as_by_stable_baselines() -> None:
    rows = DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")] * 4)
    theirs = VecNormalize(rows, norm_obs=False, gamma=0.9)
    ours, rng = ReturnScale(4, 0.9, torch.device("cpu")), np.random.default_rng(0)
    for step in range(60):
        reward = (rng.normal(size=4) * (100.0 if step == 30 else 3.0)).astype(np.float32)
        if step == 50:
            reward[0] = 1e4  # of one row, so that it is clipped
        done = rng.random(4) < 0.2
        theirs._update_reward(reward)
        expected = theirs.normalize_reward(reward)
        theirs.returns[done] = 0.0
        found = ours.scaled(torch.from_numpy(reward), torch.from_numpy(done))
        np.testing.assert_allclose(found.numpy(), expected, rtol=2e-4)
        if step == 40:
            saved = {name: values.clone() for name, values in ours.state_dict().items()}
            ours.scaled(torch.ones(4), torch.zeros(4, dtype=torch.bool))  # goes on elsewhere
            ours = ReturnScale(4, 0.9, torch.device("cpu"))
            ours.load_state_dict(saved)
