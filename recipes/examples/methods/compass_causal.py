"""COMPASS (Huang et al. 2023): simulator parameters identified by a causal model of the trajectory gap.

Windows are replayed with parameters from a box. A causal model says which parameter reaches which gap,
those that matter move to the predicted minimum, and the box shrinks around them. The policy is trained at
that point, with noise from the task's ranges.
"""

from dataclasses import dataclass

import torch
from torch.nn.functional import elu

from astra_data.core.config import AtOnce, Config, Count
from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive
from astra_data.grounding.open_loop import distances
from astra_data.grounding.simulator import Grounding
from astra_data.methods.method import Method, Table
from astra_data.worlds.variation import Variation

HIDDEN, FEATURES = 64, 32

# What replays identify: noise brings none closer to a recording, and scales of sensors would hide errors of the motion.
STEERING = {"friction", "action_scale", "heading_bias_deg", "timestep_scale", "ball_friction", "contact_direction_deg"}
SENSING = "observation_scale"


class CompassConfig(Config):
    iterations: Count = 5
    contexts: AtOnce = 128  # parameter sets, with each of which every window is replayed
    windows: AtOnce = 500
    window: AtOnce = 25  # steps
    outlier_share: float = 0.05  # of the windows with the largest gaps, left out
    shrink: float = 0.6
    updates: Count = 1000
    batch_size: AtOnce = 128
    learning_rate: float = 3e-3
    mask_learning_rate: float = 0.03
    sparsity: float = 0.01
    mask_threshold: float = 0.3


class CausalModel(torch.nn.Module):
    """Predict y_j = d(Σ_i m_ij e(x_i, i), j), where the mask m has a 1 where cause i reaches effect j."""

    def __init__(self, causes, effects):
        super().__init__()
        self.logits = torch.nn.Parameter(torch.full((causes, effects), 3.0))
        self.cause_code = torch.nn.Parameter(torch.randn(causes, HIDDEN))
        self.cause_weight = torch.nn.Parameter(torch.randn(HIDDEN))
        self.encoder = torch.nn.Linear(HIDDEN, FEATURES)
        self.effect_code = torch.nn.Parameter(torch.randn(effects, HIDDEN))
        self.decoder, self.output = torch.nn.Linear(FEATURES, HIDDEN), torch.nn.Linear(HIDDEN, 1)

    def draw_mask(self, count):
        """Draw masks (count, I, J) by a straight-through Gumbel sigmoid of temperature 1."""
        uniform = torch.rand(count, *self.logits.shape, device=self.logits.device).clamp(1e-6, 1 - 1e-6)
        soft = (self.logits + uniform.logit()).sigmoid()
        return (soft > 0.5).float() + soft - soft.detach()

    def forward(self, cause, mask):  # (B, I), (B, I, J) or (I, J) -> (B, J)
        feature = self.encoder(elu(cause[..., None] * self.cause_weight + self.cause_code))
        return self.output(elu(self.decoder(mask.transpose(-1, -2) @ feature) + self.effect_code))[..., 0]


def fit_causes(cause, effect, config, penalized):
    """Fit a causal model to causes (N, I) and effects (N, J); `penalized` masks are to be sparse."""
    model = CausalModel(cause.shape[1], effect.shape[1]).to(cause.device)
    networks = [weight for name, weight in model.named_parameters() if name != "logits"]
    masks = {"params": [model.logits], "lr": config.mask_learning_rate}
    optimizer = torch.optim.Adam([{"params": networks}, masks], lr=config.learning_rate)
    for _ in range(config.updates):
        rows = torch.randint(len(cause), (config.batch_size,), device=cause.device)
        wrong = model(cause[rows], model.draw_mask(config.batch_size)) - effect[rows]
        loss = wrong.square().mean() + config.sparsity * model.logits.sigmoid()[:penalized].mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return model.requires_grad_(False)


def descend(model, mask, start, moves, others):
    """Move those causes (P,) in [-1, 1] that `moves` names to where the smallest mean effect is expected."""
    causes = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([causes], lr=0.02)
    for _ in range(200):
        expected = model(torch.cat([causes.expand(len(others), -1), others], dim=-1), mask).mean()
        causes.grad = torch.autograd.grad(expected, causes)[0] * moves
        optimizer.step()
        with torch.no_grad():
            causes.clamp_(-1.0, 1.0)
    return causes.detach()


def parameters_at(kind, point):
    """Return parameters (P,) with the values in `point`, and otherwise those of the plain simulator."""
    return kind(**{name: (value, value) for name, value in point.items()}).ranges()[:, 0]


@torch.no_grad()
def gaps_of(task, episodes, episode, first, length, parameters, seed):
    """Replay W windows with each of `parameters` (C, P); return their mean distances (C, W, Q)."""
    windows, device = episodes.windows, str(episodes.windows.state.device)
    steps = episode[:, None], first[:, None] + torch.arange(length, device=first.device)
    state, action, after = windows.state[episode, first], windows.action[steps], windows.next_state[steps]
    simulator = task.varied_simulator(len(state), type(task.varied.wide)(), device)
    gaps = []
    for values in parameters:
        torch.manual_seed(seed)
        simulator.parameters = values.to(device).expand(len(state), -1)
        simulator.reset_to(state)
        wrong = [simulator.step(action[:, i]) - after[:, i] for i in range(length)]
        gaps.append(distances(task, torch.stack(wrong)).mean(0))
    return torch.stack(gaps)


def beginnings(episodes, length):
    """Return the episode and the first step, (N,) each, of every window."""
    steps = torch.arange(episodes.windows.mask.shape[1], device=episodes.lengths.device)
    found = (steps <= (episodes.lengths - length)[:, None]).nonzero()
    if not len(found):
        raise BadInputError(f"no episode has {length} steps: shorten window in [user_methods.compass_causal]")
    return found.unbind(1)


@dataclass(frozen=True)
class IdentifiedParameters(Grounding):
    kind = "compass_causal"

    variation: Variation

    def simulator(self, task, num_envs, device="cpu", *, variation=None, **others):
        return super().simulator(task, num_envs, device, variation=self.variation, **others)

    def for_replay(self):
        ranges = self.variation
        return IdentifiedParameters(type(ranges)(**ranges.model_dump(include=STEERING)))

    def to_file(self):
        return {"ranges": self.variation.ranges()}, {"variation": self.variation.model_dump()}

    @classmethod
    def from_file(cls, tensors, metadata, device):
        return cls(Variation.of_json(metadata["variation"]))


def within(value, ends):
    return min(max(value, ends[0]), ends[1])


def fit(fitting):
    task, config, ranges = fitting.task, fitting.settings, fitting.task.varied.wide
    kind, box = type(ranges), type(ranges)(**ranges.model_dump(exclude={SENSING}))
    point = {name: within(plain[0], getattr(box, name)) for name, plain in kind() if name in STEERING}
    for iteration in range(config.iterations):
        point, box = improved(fitting, point, box, f"compass {iteration}")
        fitting.progress((iteration + 1) / config.iterations, str({n: round(v, 3) for n, v in point.items()}))
    episode, first = beginnings(fitting.held_out, config.window)
    apart = first % config.window == 0
    both = torch.stack([parameters_at(kind, {}), parameters_at(kind, point)])
    gaps = gaps_of(task, fitting.held_out, episode[apart], first[apart], config.window, both, fitting.seed)
    plain, identified = gaps.mean(1).tolist()
    found = ranges.model_copy(update={name: (value, value) for name, value in point.items()})
    return IdentifiedParameters(found), {"point": point, "held_out_gap": [plain, identified]}


def improved(fitting, point, box, name):
    """Do one iteration; return the point and the box after it."""
    task, config, device, kind = fitting.task, fitting.settings, fitting.device, type(box)
    torch.manual_seed(derive(fitting.seed, f"{name} windows"))
    episode, first = beginnings(fitting.training, config.window)
    drawn = torch.randint(len(episode), (config.windows,), device=device)
    episode, first, noise = episode[drawn], first[drawn], derive(fitting.seed, f"{name} noise")
    contexts = box.draw(config.contexts, device)
    gaps = gaps_of(task, fitting.training, episode, first, config.window, contexts, noise)
    of_window = gaps.mean(0)
    usual = (of_window <= of_window.quantile(1 - config.outlier_share, dim=0)).all(-1)
    # Gaps vary far more between windows than with parameters: learn the difference within a window.
    difference = (gaps - of_window)[:, usual]
    scale = difference.std((0, 1)).clamp_min(1e-9)
    varied = [parameter for parameter, (low, high) in box.model_dump().items() if low < high]
    columns = [box.names.index(parameter) for parameter in varied]
    windows = fitting.training.windows
    steps = episode[:, None], first[:, None] + torch.arange(config.window, device=device)
    state, goal = windows.state[episode, first], windows.goal[episode, first]
    seen = state[:, 2:] if task.plane else task.objective.observe(state, goal)  # not where in the maze
    summary = torch.cat([seen, windows.action[steps].mean(1)], dim=-1)[usual]
    parameters = box.normal(contexts)[:, None, columns].expand(-1, len(summary), -1)
    cause = torch.cat([parameters, summary.expand(len(contexts), -1, -1)], dim=-1).flatten(0, 1)
    torch.manual_seed(derive(fitting.seed, f"{name} model"))
    model = fit_causes(cause, (difference / scale).flatten(0, 1), config, len(varied))
    mask = (model.logits.sigmoid() > config.mask_threshold).float()
    steers = torch.tensor([parameter in STEERING for parameter in varied], device=device)
    moves = mask[: len(varied)].any(-1) & steers
    here = box.normal(parameters_at(kind, point))[columns].to(device)
    low, high = box.ranges()[columns].unbind(-1)
    values = low + (descend(model, mask, here, moves, summary).cpu() + 1) / 2 * (high - low)
    there = zip(varied, values.tolist(), moves.tolist(), strict=True)
    moved = {one: within(value, getattr(box, one)) for one, value, moving in there if moving}
    # The model smooths over edges of the gap, so the step is accepted only if replays confirm it.
    both = torch.stack([parameters_at(kind, point), parameters_at(kind, point | moved)])
    both = gaps_of(task, fitting.training, episode[usual], first[usual], config.window, both, noise)
    before, after = (both / scale).mean((1, 2))
    point = point | moved if after < before else point
    ends = box.model_dump()
    for one in moved:
        reach = config.shrink * (ends[one][1] - ends[one][0]) / 2
        ends[one] = tuple(within(point[one] + sign * reach, ends[one]) for sign in (-1, 1))
    return point, kind(**ends)


METHOD = Method(
    name="compass_causal",
    title="COMPASS (Huang et al.)",
    color="#F0E442",
    fit=fit,
    grounding=IdentifiedParameters,
    table=Table("compass_causal", CompassConfig),
    configures="ground",
)
