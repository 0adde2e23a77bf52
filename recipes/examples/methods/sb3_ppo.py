"""PPO of Stable-Baselines3 in NAS's simulator: a learner of one's own as a row. Needs astra-data[sb3]."""

import numpy as np
from gymnasium.spaces import Box
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv

from astra_data.methods.astra import NAS
from astra_data.methods.method import Method
from astra_data.policies.train import UserLearner


class StableBaselinesEnv(VecEnv):
    """A vector environment of Gymnasium as one of Stable-Baselines3, whose interface is another."""

    def __init__(self, env):
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self):
        observation, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observation

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        observation, reward, terminated, truncated, infos = self.env.step(self.actions)
        done = terminated | truncated
        facts = [{} for _ in done]
        for row in np.flatnonzero(done):
            late = bool(truncated[row] and not terminated[row])
            facts[row] = {"terminal_observation": infos["final_obs"][row], "TimeLimit.truncated": late}
        return observation, reward, done, facts

    def close(self):
        pass

    def get_attr(self, attr_name, indices=None):
        return [None] * self.num_envs

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError("rows of one batch have no attributes of their own")

    def env_method(self, method_name, *args, indices=None, **kwargs):
        raise NotImplementedError("rows of one batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


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
