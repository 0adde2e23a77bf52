"""PPO of Stable-Baselines3 in NAS's simulator: a learner of one's own as a row. Needs astra-data[sb3]."""

import numpy as np
from gymnasium.spaces import Box
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy

from astra_data.methods.astra import NAS
from astra_data.methods.method import Method
from astra_data.policies.stable_baselines import StableBaselinesEnv
from astra_data.policies.train import UserLearner


class Sb3Policy:
    kind = "stable-baselines3 ppo"

    def __init__(self, policy):
        self.policy = policy

    def act(self, observation):  # (B, O) in, (B, A) within ±1 out
        return self.policy.predict(observation, deterministic=True)[0]

    def to_file(self):
        return self.policy.state_dict(), {}

    @classmethod
    def from_file(cls, tensors, metadata):
        seen = Box(-np.inf, np.inf, (tensors["mlp_extractor.policy_net.0.weight"].shape[1],))
        policy = ActorCriticPolicy(seen, Box(-1.0, 1.0, tensors["log_std"].shape), lambda progress: 0.0)
        policy.load_state_dict(tensors)
        return cls(policy)


def learn(env, training):
    config = training.config
    model = PPO(
        "MlpPolicy",
        StableBaselinesEnv(env),
        n_steps=config.rollout_steps,
        batch_size=config.rollout_steps * config.num_envs // 4,
        learning_rate=config.learning_rate,
        gamma=config.discount,
        seed=training.seed,
        device="cpu",
    )
    return Sb3Policy(model.learn(config.total_steps).policy)


METHOD = Method(
    name="sb3_ppo",
    title="NAS, PPO of SB3",
    color="#7F7F7F",
    fit=NAS.fit,
    grounded_as="nas",
    learn=UserLearner(learn=learn, policy=Sb3Policy),
)
