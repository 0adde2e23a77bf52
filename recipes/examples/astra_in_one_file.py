"""ASTRA from top to bottom, to read beside the paper (Section IV).

    astra-data run recipes/quickstart.toml --until pair
    python recipes/examples/astra_in_one_file.py runs/quickstart/pair recipes/examples/cart/robot.py:TASK

fits ψ^s, P_lat, R_pred and f_abs to a paired dataset (Algorithm 1), trains a policy by PPO in the grounded
simulator (Algorithm 2), aligns ψ^t, and tests the policy in the target. It is the package's row `astra`, less
failure model, scatter, checkpoints and restarts, for tasks without a maze.

Shapes: B batch, T steps, E episodes, S target state, X abstract state, A action, G goal, Z latent.
"""

import copy
import math
import sys
from functools import partial
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import nn

from astra_data import Dataset


# ---- Paired episodes: beside (s_i, a_i, s_{i+1}), where the abstract simulator lands from φ(s_i) under a_i
def load_episodes(folder, task):
    """Return the paired episodes, each column padded to (E, T, ...); `mask` (E, T) is 1 on real steps."""
    dataset, names = Dataset.open(folder), {"target_state": "observation.state", "action": "action"}
    names |= {"state": "abstract.state", "next_state": "abstract.next_state"}  # φ(s_i), φ(s_{i+1})
    names |= {"simulated_next": "abstract.simulated_next_state"}  # the simulator's from φ(s_i) under a_i
    names |= {name: f"next.{name}" for name in ("reward", "terminated", "success")}
    if task.objective.goal_size:
        names["goal"] = "observation.environment_state"
    steps = dataset.columns(list(names.values()))
    lengths = torch.tensor(dataset.lengths)
    columns = {}
    for name, column in names.items():
        values = torch.tensor(steps[column]).float()
        values = values if column.startswith("next.") else values.reshape(len(values), -1)
        values = task.limits.normal(values) if name == "action" else values  # ±1 along each axis
        columns[name] = nn.utils.rnn.pad_sequence(values.split(lengths.tolist()), batch_first=True)
    mask = (torch.arange(int(lengths.max())) < lengths[:, None]).float()
    columns.setdefault("goal", torch.zeros(*mask.shape, 0))
    columns["previous_action"] = nn.functional.pad(columns["action"][:, :-1], (0, 0, 1, 0))  # a_{i-1}
    # Simulators see themselves that a goal is reached, and pay for it: there R_pred has nothing to learn.
    # Elsewhere, a policy is paid the task's own reward on abstract states, plus a predicted residual.
    flat = [columns[name].flatten(0, 1) for name in ("state", "next_state", "goal")]
    shown = task.objective.decided(*flat[1:])
    own = task.objective.reward(*flat, torch.zeros_like(shown)).reshape(mask.shape)
    columns["reward"] = torch.stack([columns["reward"], columns["reward"] - own], dim=-1)
    ended = columns.pop("terminated") * columns.pop("success")
    columns["learns_reward"] = mask * (1.0 - ended) * ~shown.reshape(mask.shape)
    return columns | {"mask": mask, "lengths": lengths}


def selected(episodes, rows):
    return {name: values[rows] for name, values in episodes.items()}


def draw_windows(episodes, count, length):
    """Draw windows (count, length, ...), each step equally likely; the mask is 1 on what was drawn."""
    lengths = episodes["lengths"]
    length = min(length, int(lengths.max()))
    beginnings = lengths + length - 1
    rows = torch.multinomial(beginnings.float(), count, replacement=True)
    drawn = (torch.rand(count) * beginnings[rows]).long() - (length - 1)
    first = drawn.clamp_min(0).minimum((lengths[rows] - length).clamp_min(0))  # shifted into the episode
    steps = first[:, None] + torch.arange(length)
    windows = {name: values[rows[:, None], steps] for name, values in episodes.items() if name != "lengths"}
    windows["mask"] = windows["mask"] * ((steps >= drawn[:, None]) & (steps < drawn[:, None] + length))
    return windows


def mlp(*sizes):
    layers = [layer for pair in pairwise(sizes) for layer in (nn.Linear(*pair), nn.ELU())]
    return nn.Sequential(*layers[:-1])


def normalized(values, mean, std):
    return ((values - mean) / std).clamp(-5.0, 5.0)


# ψ: a GRU, whose layer-normalized hidden state is the latent: L_trans would shrink it without limit.
class Encoder(nn.Module):
    def __init__(self, input_size, latent_size, embedding_size=64):
        super().__init__()
        self.embedding = nn.Linear(input_size, embedding_size)
        self.recurrence = nn.GRU(embedding_size, latent_size, batch_first=True)

    def forward(self, inputs):
        """Return the latents (B, T, Z) of inputs (B, T, I), and the hidden states."""
        hidden, _ = self.recurrence(nn.functional.elu(self.embedding(inputs)))
        return self.latent(hidden), hidden

    def step(self, inputs, hidden):
        (weights,) = self.recurrence.all_weights
        return torch.gru_cell(nn.functional.elu(self.embedding(inputs)), hidden, *weights)

    def latent(self, hidden):
        return nn.functional.layer_norm(hidden, hidden.shape[-1:])


# An encoder of histories (state, goal, previous action), of abstract or of target states.
class HistoryModel(nn.Module):
    def __init__(self, state_size, goal_size, action_size, latent_size=64):
        super().__init__()
        self.encoder = Encoder(state_size + goal_size + action_size, latent_size)
        self.add_scales(state=state_size, goal=goal_size)

    def add_scales(self, **sizes):
        for name, size in sizes.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def set_scale(self, name, values):
        """Take mean and deviation of real steps (N, size)."""
        if values.numel():
            getattr(self, f"{name}_mean").copy_(values.mean(0))
            getattr(self, f"{name}_std").copy_(values.std(0).clamp_min(1e-3))

    def inputs(self, state, goal, previous_action):
        state = normalized(state, self.state_mean, self.state_std)
        return torch.cat([state, normalized(goal, self.goal_mean, self.goal_std), previous_action], dim=-1)


# ψ^s, P_lat, R_pred and f_abs on one backbone (Section IV-A).
class Grounding(HistoryModel):
    def __init__(self, state_size, goal_size, action_size, latent_size=64):
        super().__init__(state_size, goal_size, action_size, latent_size)
        given = latent_size + action_size
        self.latent_dynamics = mlp(given, 128, 128, 2 * latent_size)
        self.reward_head = mlp(given, 128, 128, 2)  # the reward, and its residual
        self.correction = mlp(given + state_size, 128, 128, state_size)
        for parameter in self.correction[-1].parameters():  # untrained, it is the raw simulator
            nn.init.zeros_(parameter)
        self.target_encoder = copy.deepcopy(self.encoder).requires_grad_(False)
        self.add_scales(correction=state_size, reward=2)
        self.register_buffer("reward_shrinkage", torch.ones(()))

    def set_scales(self, episodes):
        real, missed = episodes["mask"].bool(), episodes["next_state"] - episodes["simulated_next"]
        for name, values in {
            "state": episodes["state"],
            "goal": episodes["goal"],
            "correction": missed,
        }.items():
            self.set_scale(name, values[real])
        reward = episodes["reward"][episodes["learns_reward"].bool()]
        self.reward_mean.copy_(reward.mean(0))
        self.reward_std.copy_(reward.std(0, correction=0).clamp_min(1e-3))

    def encode(self, windows):
        """ψ^s: return the latents z_i^s (B, T, Z) of abstract histories Φ(h_i), and the hidden states."""
        return self.encoder(self.inputs(windows["state"], windows["goal"], windows["previous_action"]))

    def predict_latent(self, latent, action):
        """P_lat: return mean and log-variance (..., Z) of the next latent."""
        mean, raw = self.latent_dynamics(torch.cat([latent, action], dim=-1)).chunk(2, dim=-1)
        return mean, -6.0 + 8.0 * torch.sigmoid(raw)

    def normal_reward(self, latent, action):
        return self.reward_head(torch.cat([latent, action], dim=-1))

    def predict_residual(self, latent, action):
        """R_pred: return by how much the target's reward (...) is above the task's own on abstract states."""
        rewards = self.normal_reward(latent, action) * self.reward_std + self.reward_mean
        return rewards[..., -1] * self.reward_shrinkage

    @torch.no_grad()
    def shrink_reward(self, windows):
        """Shrink residuals to what they explain of held-out ones: errors must not pay."""
        known = windows["learns_reward"].bool()
        predicted = self.predict_residual(self.encode(windows)[0], windows["action"])[known]
        slope = (predicted * windows["reward"][known][:, -1]).sum() / predicted.square().sum()
        self.reward_shrinkage.copy_(slope.clamp(0.0, 1.0))

    def correct(self, latent, action, simulated_next):
        """f_abs: return the corrected next abstract state (..., X)."""
        landed = normalized(simulated_next, self.state_mean, self.state_std)
        return simulated_next + self.correction(torch.cat([latent, action, landed], -1)) * self.correction_std

    def losses(self, windows, latent_weight=0.1, reward_weight=1.0):
        """Return λ1 L_trans + λ2 L_rew + L_abs, and the three; means over real steps."""
        inputs = self.inputs(windows["state"], windows["goal"], windows["previous_action"])
        latent, _ = self.encoder(inputs)
        action, mask = windows["action"], windows["mask"]
        with torch.no_grad():  # by a slow copy of ψ^s: predicting a constant latent exactly must not pay
            following = self.target_encoder(inputs)[0][:, 1:]
        mean, log_variance = self.predict_latent(latent[:, :-1], action[:, :-1])
        nll = 0.5 * ((following - mean).square() / log_variance.exp() + log_variance).mean(-1)
        trans = masked_mean(nll, mask[:, :-1] * mask[:, 1:])
        reward = (windows["reward"] - self.reward_mean) / self.reward_std
        error = 0.5 * (self.normal_reward(latent, action) - reward).square().sum(-1)
        rew = masked_mean(error, windows["learns_reward"] * mask)
        corrected = self.correct(latent, action, windows["simulated_next"])
        error = ((corrected - windows["next_state"]) / self.correction_std).square().mean(-1)
        abstract = masked_mean(error, mask)
        return latent_weight * trans + reward_weight * rew + abstract, (trans, rew, abstract)

    @torch.no_grad()
    def follow(self, rate=0.01):
        for slow, fast in zip(self.target_encoder.parameters(), self.encoder.parameters(), strict=True):
            slow.lerp_(fast, rate)


def masked_mean(values, mask):
    return (values * mask).sum() / mask.sum().clamp_min(1.0)


# ---- Algorithm 1: fit the grounding; and Section IV-B: align the target encoder
def descend(model, loss_of, error_of, training, held_out, after=lambda: None, window=50, batch=48):
    """Descend `loss_of` windows with a decaying rate; return to the weights with the least held-out error."""
    updates = min(max(round(32 * int(training["lengths"].sum()) / (batch * window)), 600), 1200)
    optimizer = torch.optim.AdamW([p for p in model.parameters() if p.requires_grad], 3e-3, weight_decay=0.0)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    least, best = math.inf, None
    for update in range(1, updates + 1):
        loss = loss_of(draw_windows(training, batch, window))
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        after()
        if update % 100 == 0:
            error = float(error_of(held_out).detach())
            if error < least:
                least, best = error, copy.deepcopy(model.state_dict())
            print(f"  update {update} of {updates}: held-out error {error:.4f}")
    model.load_state_dict(best)
    return model.requires_grad_(False)


def ground(training, held_out):
    """Fit ψ^s, P_lat, R_pred and f_abs (Algorithm 1)."""
    model = Grounding(*(training[name].shape[-1] for name in ("state", "goal", "action")))
    model.set_scales(training)
    error_of = partial(model.losses, latent_weight=0.0)  # latents have no scale to compare
    descend(model, lambda w: model.losses(w)[0], lambda w: error_of(w)[0], training, held_out, model.follow)
    model.shrink_reward(held_out)
    return model


def gaussian_mmd(mean_1, variance_1, mean_2, variance_2, bandwidths):
    """Return the squared MMD (...) of diagonal Gaussians (..., Z), in closed form; kernels are averaged."""

    def mean_kernel(m1, v1, m2, v2):
        squared = bandwidths.square().unsqueeze(-1)
        spread = squared + (v1 + v2).unsqueeze(-2)
        exponent = 0.5 * ((squared / spread).log() - (m1 - m2).unsqueeze(-2).square() / spread)
        return exponent.sum(-1).exp().mean(-1)

    first, second = (mean_1, variance_1), (mean_2, variance_2)
    return mean_kernel(*first, *first) + mean_kernel(*second, *second) - 2.0 * mean_kernel(*first, *second)


def alignment_losses(model, target, windows):
    """Return L_align = MMD²(p_i^s, p_i^t), and the squared distance of paired latents."""
    with torch.no_grad():
        source, _ = model.encode(windows)
        source_mean, source_log_variance = model.predict_latent(source, windows["action"])
    inputs = target.inputs(windows["target_state"], windows["goal"], windows["previous_action"])
    latent, _ = target.encoder(inputs)
    mean, log_variance = model.predict_latent(latent, windows["action"])
    bandwidths = torch.tensor([0.25, 0.5, 1.0, 2.0]) * latent.shape[-1] ** 0.5
    mmd = gaussian_mmd(source_mean, source_log_variance.exp(), mean, log_variance.exp(), bandwidths)
    return (masked_mean(v, windows["mask"]) for v in (mmd, (latent - source).square().mean(-1)))


def align(model, training, held_out):
    """Fit ψ^t on full target states, with all else frozen; pairs tell more than distributions alone."""
    target = HistoryModel(*(training[name].shape[-1] for name in ("target_state", "goal", "action")))
    for name, column in {"state": "target_state", "goal": "goal"}.items():
        target.set_scale(name, training[column][training["mask"].bool()])
    return descend(target, *[lambda w: sum(alignment_losses(model, target, w))] * 2, training, held_out)


# ---- Algorithm 2: the grounded simulator, and PPO in it
def seen_by_policy(objective, latent, state, goal):
    return torch.cat([latent / latent.shape[-1] ** 0.5, objective.observe(state, goal)], dim=-1)


# B episodes in the grounded simulator; half of them start amid recorded ones, with their histories.
class GroundedEnv:
    def __init__(self, task, model, episodes, num_envs=256, data_start_share=0.5):
        self.model, self.objective = model, task.objective
        self.simulator, self.num_envs = task.simulator(num_envs), num_envs
        self.hidden = torch.zeros(num_envs, model.encoder.recurrence.hidden_size)
        self.goal = torch.zeros(num_envs, self.objective.goal_size)
        self.data_start_share, names = data_start_share, ("state", "goal", "previous_action")
        with torch.no_grad():
            _, hidden = model.encode(episodes)
        before = nn.functional.pad(hidden[:, :-1], (0, 0, 1, 0))
        recorded = {name: episodes[name] for name in names} | {"hidden": before}
        self.recorded = selected(recorded, episodes["mask"].bool())

    def observe(self):
        latent = self.model.encoder.latent(self.hidden)
        return seen_by_policy(self.objective, latent, self.simulator.state, self.goal)

    @torch.no_grad()
    def reset(self, done):
        """Restart the rows that are `done` (B,) bool; return observations (B, O)."""
        rows = done.nonzero().squeeze(1)
        if len(rows):
            from_data = torch.rand(len(rows)) < self.data_start_share
            fresh, rng = rows[~from_data], np.random.default_rng(int(torch.randint(2**62, ())))
            draws = self.objective.draw_starts, self.objective.draw_goals
            state, goal = (torch.from_numpy(draw(rng, len(fresh))).float() for draw in draws)
            action = torch.zeros(len(fresh), self.objective.action_size)
            self._start(fresh, state, goal, action, torch.zeros(len(fresh), self.hidden.shape[1]))
            moments = torch.randint(len(self.recorded["state"]), (int(from_data.sum()),))
            self._start(rows[from_data], **selected(self.recorded, moments))
        return self.observe()

    def _start(self, rows, state, goal, previous_action, hidden):
        self.simulator.reset_to(state, rows)
        self.goal[rows] = goal
        self.hidden[rows] = self.model.encoder.step(self.model.inputs(state, goal, previous_action), hidden)

    @torch.no_grad()
    def step(self, action):
        """Return reward, whether the episode ends, and whether it succeeds, each (B,), of actions (B, A)."""
        action = self.objective.limit_command(action, math.inf)
        before, latent = self.simulator.state, self.model.encoder.latent(self.hidden)
        landed = self.simulator.step(action)
        after = self.simulator.settle(before, self.model.correct(latent, action, landed))
        self.hidden = self.model.encoder.step(self.model.inputs(after, self.goal, action), self.hidden)
        success, failed = self.objective.reached(after, self.goal), self.objective.missed(after, self.goal)
        ended = success | failed
        paid = self.objective.reward(before, after, self.goal, failed)
        return paid + ~ended * self.model.predict_residual(latent, action), ended, success


# A Gaussian policy, whose mean is clipped to ±1 with the gradient of the output, and a value.
class ActorCritic(nn.Module):
    def __init__(self, observation_size, action_size):
        super().__init__()
        self.actor = mlp(observation_size, 64, 64, action_size)
        self.critic = mlp(observation_size, 64, 64, 1)
        self.log_std = nn.Parameter(torch.full((action_size,), -0.5))
        for network, gain in ((self.actor, 0.01), (self.critic, 1.0)):
            for layer in network[::2]:
                nn.init.orthogonal_(layer.weight, 2**0.5)
                nn.init.zeros_(layer.bias)
            nn.init.orthogonal_(network[-1].weight, gain)
        self.critic[-1].weight.data.mul_(0.01)  # its values must not exceed small returns

    def mean(self, output):
        return output + (output.clamp(-1.0, 1.0) - output).detach()

    def value(self, observation):
        return self.critic(observation).squeeze(-1)

    def log_prob(self, mean, action):
        std = self.log_std.exp().expand_as(mean)
        return (((action - mean) / std).square() / -2 - std.log() - math.log(2 * math.pi) / 2).sum(-1)


# Proximal policy optimization (Schulman et al. 2017), by the package's settings.
class Ppo:
    def __init__(self, env, policy, total_steps=2_000_000, rollout_steps=64, discount=0.99):
        self.env, self.policy, self.total_steps = env, policy, total_steps
        self.rollout_steps, self.discount, self.horizon = rollout_steps, discount, env.objective.horizon
        self.optimizer = torch.optim.Adam(policy.parameters(), lr=5e-4, eps=1e-5, fused=True)
        self.first_std = float(policy.log_std.detach().exp().max())
        self.sums = torch.zeros(env.num_envs)  # discounted returns, whose running deviation scales rewards
        self.count, self.mean, self.var = torch.tensor([1e-4, 0.0, 1.0], dtype=torch.float64)
        self.observation = env.reset(torch.ones(env.num_envs, dtype=torch.bool))
        self.age, self.share = torch.randint(self.horizon, (env.num_envs,)), 0.0  # not all end at once

    def scaled(self, reward, done):
        self.sums = self.sums * self.discount + reward
        sums, size = self.sums.double(), len(reward)
        apart, total = sums.mean() - self.mean, self.count + size
        spread = self.var * self.count + sums.var(correction=0) * size
        self.var = (spread + apart.square() * self.count * size / total) / total
        self.mean, self.count = self.mean + apart * size / total, total
        self.sums = torch.where(done, 0.0, self.sums)
        return (reward / (self.var + 1e-8).sqrt().float()).clamp(-10.0, 10.0)

    @torch.no_grad()
    def collect(self):
        """Return a rollout, each column (B, T, ...), with advantages (eq. 11), and the episodes' success."""
        rollout, succeeded, finished = {}, 0, 0
        for _ in range(self.rollout_steps):
            mean = self.policy.mean(self.policy.actor(self.observation))
            action = torch.normal(mean, self.policy.log_std.exp().expand_as(mean))
            reward, ended, success = self.env.step(action)
            self.age += 1
            expired = (self.age >= self.horizon) & ~ended
            done = ended | expired
            beyond = torch.where(expired, self.policy.value(self.env.observe()), 0.0)
            row = {"observation": self.observation, "action": action, "ended": ended, "done": done}
            log_prob, scaled = self.policy.log_prob(mean, action), self.scaled(reward, done)
            row |= {"log_prob": log_prob, "beyond": beyond, "reward": scaled}
            rollout = {name: [*rollout.get(name, []), values] for name, values in row.items()}
            self.age[done] = 0
            self.observation = self.env.reset(done)
            succeeded, finished = succeeded + int(success.sum()), finished + int(done.sum())
        rollout = {name: torch.stack(values, dim=1) for name, values in rollout.items()}
        value = self.policy.value(rollout["observation"])
        following = torch.cat([value[:, 1:], self.policy.value(self.observation).unsqueeze(1)], dim=1)
        following = torch.where(rollout["done"], rollout["beyond"], following)
        error = rollout["reward"] + self.discount * following * ~rollout["ended"] - value
        advantage, later = torch.empty_like(error), torch.zeros(len(error))
        for step in reversed(range(self.rollout_steps)):
            later = error[:, step] + self.discount * 0.95 * ~rollout["done"][:, step] * later
            advantage[:, step] = later
        normal = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        rollout |= {"target": advantage + value, "advantage": normal}
        return rollout, succeeded / finished if finished else math.nan

    def loss(self, batch):
        """Return the clipped objective's loss, and how far the policy has moved, by the KL divergence."""
        names = "observation", "action", "log_prob", "advantage", "target"
        observation, action, before, advantage, target = (batch[name].flatten(0, 1) for name in names)
        output = self.policy.actor(observation)
        moved = self.policy.log_prob(self.policy.mean(output), action) - before
        ratio = moved.exp()
        gain = torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
        critic_loss = (self.policy.value(observation) - target).square().mean()
        beyond = (output.abs() - 1.0).clamp_min(0.0).square().mean()
        return 0.5 * critic_loss - gain + 0.05 * beyond, -moved.mean()

    def learn(self, rollout):
        segments = {name: values.unflatten(1, (-1, 16)).flatten(0, 1) for name, values in rollout.items()}
        for _ in range(5):
            for rows in torch.randperm(len(segments["action"])).chunk(16):
                loss, moved = self.loss(selected(segments, rows))
                if moved.abs() > 0.03:
                    return
                self.optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self.policy.parameters(), 0.5)
                self.optimizer.step()

    def iterate(self, pace=1.0):
        """Collect a rollout and learn from it; return the share of its episodes that succeeded."""
        self.optimizer.param_groups[0]["lr"] = 5e-4 * (1.0 - self.share)
        rollout, success = self.collect()
        self.learn(rollout)
        # Action noise fades, so that the policy is trained as it is tested.
        limit = math.log(self.first_std) + min(1.0, self.share / 0.5) * math.log(0.15 / self.first_std)
        self.policy.log_std.data.clamp_(max=limit)
        self.share = min(1.0, self.share + pace * self.env.num_envs * self.rollout_steps / self.total_steps)
        return success


def train(task, model, episodes):
    """Train a policy in the grounded simulator; one that has mastered it ends six times as fast."""
    env = GroundedEnv(task, model, episodes)
    ppo = Ppo(env, ActorCritic(env.observe().shape[1], task.objective.action_size))
    recent = []
    while ppo.share < 1.0 - 1e-9:
        recent = [*recent, ppo.iterate(pace=6.0 if recent and np.nanmean(recent) >= 0.95 else 1.0)][-5:]
        print(f"  {ppo.share:.0%} of the training: success {np.nanmean(recent):.2f}")
    return ppo.policy


# ---- Deploy: latents of real histories, by ψ^t on target states or by ψ^s on φ of them
@torch.no_grad()
def success_in_target(task, policy, encoder, abstraction, episodes=100, seed=0):
    """Return the share of the episodes in the target in which the policy succeeds, by mean actions."""
    env = task.target(episodes, seed=seed)
    env.reset()
    sizes = task.objective.action_size, encoder.encoder.recurrence.hidden_size
    action, hidden = (torch.zeros(episodes, size) for size in sizes)
    active, success = (torch.full((episodes,), value) for value in (True, False))
    for _ in range(task.objective.horizon):
        hidden = encoder.encoder.step(encoder.inputs(abstraction(env.state), env.goal, action), hidden)
        latent = encoder.encoder.latent(hidden)
        observation = seen_by_policy(task.objective, latent, task.abstraction(env.state), env.goal)
        action = task.objective.limit_command(policy.mean(policy.actor(observation)), math.inf)
        step = env.step(action, active)
        success |= step.success & active
        active &= ~step.terminated
    return float(success.float().mean())


def astra(dataset, task, seed=0):
    """Run all of it; print the success in the target with ψ^t and with ψ^s."""
    torch.manual_seed(seed)
    episodes = load_episodes(dataset, task)
    order = torch.randperm(len(episodes["lengths"]))
    held_out, training = (selected(episodes, rows) for rows in order.tensor_split([max(1, len(order) // 10)]))
    model = ground(training, held_out)
    policy, target = train(task, model, training), align(model, training, held_out)
    by_target = success_in_target(task, policy, target, lambda state: state)
    by_source = success_in_target(task, policy, model, task.abstraction)
    print(f"success in the target {by_target:.2f} by ψ^t, {by_source:.2f} by ψ^s")


if __name__ == "__main__":
    file, _, name = sys.argv[2].rpartition(":")
    sys.path.insert(0, str(Path(file).parent))
    astra(sys.argv[1], getattr(import_module(Path(file).stem), name))
