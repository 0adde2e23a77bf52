"""The cart below a camera of 64 x 64 pixels, rendered here: it sees pose and tilt, and drives without tracking.

python camera.py FOLDER [drives]      records drives by random commands with lerobot, with a video
python camera.py play RUN [trials]    sends the cart to its dock by what the camera sees, and counts
python camera.py compare RUN OUT      the same by pictures and by states, with either encoder
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from cart import DOCK_M, TASK
from robot import TrueCart

from astra_data import align, load_policy
from astra_data.grounding.files import TARGET_ENCODER, load_target_encoder
from astra_data.pipeline.stages.align import AlignConfig

PIXELS, LEFT_M, BOTTOM_M, WIDTH_M = 64, -2.5, -4.0, 8.0
FLOOR, DOCK, BODY, NOSE, LOAD = (90, 90, 90), (40, 160, 60), (40, 70, 200), (220, 50, 40), (240, 220, 60)
CAMERA = "observation.images.top"


def photograph(states):
    """Return pictures (B, 64, 64, 3) uint8, from above, of carts in the states (B, 8)."""
    states = np.asarray(states, np.float32)
    x, y, cos, sin = (states[:, entry, None, None] for entry in range(4))
    at = (np.arange(PIXELS, dtype=np.float32) + 0.5) * WIDTH_M / PIXELS
    east, north = LEFT_M + at[None, None, :] - x, BOTTOM_M + at[None, ::-1, None] - y
    ahead, left = cos * east + sin * north, cos * north - sin * east
    sway = 0.5 * np.sin(states[:, 6, None, None])  # of the payload, half a meter above the wheels
    dock = 0.3 - np.hypot(east + x - DOCK_M[0], north + y - DOCK_M[1])
    body = np.minimum(0.5 - abs(ahead), 0.35 - abs(left))
    nose = np.minimum(body, ahead - 0.2)
    load = 0.2 - np.hypot(ahead + 0.15, left - sway)
    picture = np.broadcast_to(np.float32(FLOOR), (len(states), PIXELS, PIXELS, 3))
    for inside, color in ((dock, DOCK), (body, BODY), (nose, NOSE), (load, LOAD)):
        cover = np.clip(0.5 + inside * PIXELS / WIDTH_M, 0, 1)[..., None]  # of the pixel, so that edges are smooth
        picture = picture + cover * (np.float32(color) - picture)
    return picture.round().astype(np.uint8)


def record(folder, drives=60, seconds=15, seed=0):
    """Drive from anywhere in the picture by random commands, each held for 0.1 to 2 s, until the payload tips."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: PLC0415 - slow, and not needed to play

    names = {"observation.state": TASK.state.names, "action": TASK.action.names, "next.terminated": ("tipped",)}
    features = {
        name: {"dtype": "bool" if name.startswith("next") else "float32", "shape": (len(each),), "names": list(each)}
        for name, each in names.items()
    }
    features[CAMERA] = {"dtype": "video", "shape": (PIXELS, PIXELS, 3), "names": ["height", "width", "channels"]}
    dataset, rng = LeRobotDataset.create("cart/camera", 10, features, root=folder), np.random.default_rng(seed)
    for _ in range(drives):
        cart = TrueCart()
        cart.reset(int(rng.integers(2**32)))
        cart.x, cart.y = rng.uniform([-1.5, -3.0], [4.5, 3.0])
        state, tipped, left = cart.state(), False, 0
        for _ in range(10 * seconds):
            if left == 0:
                command, left = rng.uniform([-0.2, -1.5], [1.0, 1.5]).astype(np.float32), rng.integers(1, 21)
            left -= 1
            row = {"observation.state": np.float32(state), "action": command, "next.terminated": np.array([tipped])}
            dataset.add_frame({**row, CAMERA: photograph([state])[0], "task": "deliver the payload"})
            if tipped:
                break
            state, tipped = cart.step(command)
        dataset.save_episode()
    dataset.finalize()


def seen(states):
    """Return what a policy is shown of carts in the states (B, 8)."""
    return {CAMERA: photograph(states)}


def deliver(policy, see, trials=100, seed=0):
    """Return how many of 100 trials a policy delivers, and tips, by what it can `see` of the states (B, 8)."""
    rng, carts = np.random.default_rng(seed), [TrueCart() for _ in range(trials)]
    states = np.array([cart.reset(int(rng.integers(2**32))) for cart in carts])
    delivered, tipped = np.zeros(trials, bool), np.zeros(trials, bool)
    policy.start(trials)
    for _ in range(policy.task.objective.horizon):
        commands = policy.command(see(states.astype(np.float32)), torch.empty(trials, 0)).numpy()
        for number in np.flatnonzero(~delivered & ~tipped):
            states[number], tipped[number] = carts[number].step(commands[number])
        delivered |= (np.linalg.norm(states[:, :2] - DOCK_M, axis=1) < 0.3) & ~tipped
    return f"delivered {delivered.mean():.2f}, tipped {tipped.mean():.2f}"


def play(run, trials=100):
    """Print which share of its trials each policy of a run delivers, and tips."""
    for trained in sorted((Path(run) / "train").glob("*/seed_*")) or sys.exit(f"{run}: expected trained policies"):
        row, seed = trained.parent.name, int(trained.name.removeprefix("seed_"))
        print(f"{row}, seed {seed}: {deliver(load_policy(run, row, seed=seed), seen, trials)}")


def compare(run, out):
    """Print how policies of a run do by pictures and by states, with either encoder; ψ^t of states goes to `out`."""
    for seen_by in sorted((Path(run) / "align/astra").glob("seed_*")) or sys.exit(f"{run}: expected ψ^t of astra"):
        seed, aligned = int(seen_by.name.removeprefix("seed_")), Path(out) / seen_by.name
        if not aligned.exists():
            pairs, grounding = Path(run) / f"pair/{seen_by.name}", Path(run) / f"ground/astra/{seen_by.name}"
            align(AlignConfig(), dataset=pairs, grounding=grounding, seed=seed, out=aligned)
        camera, tracking = (load_target_encoder(folder / TARGET_ENCODER) for folder in (seen_by, aligned))
        for row in ("astra_plus", "astra"):
            states = replace(load_policy(run, row, seed=seed), target_encoder=None, sensing=None)
            for way, policy, see in (
                ("ψ^t from pictures", replace(states, target_encoder=camera, sensing=camera), seen),
                ("ψ^s on φ from pictures", replace(states, sensing=camera), seen),
                ("ψ^t from states", replace(states, target_encoder=tracking), torch.tensor),
                ("ψ^s on φ of states", states, torch.tensor),
            ):
                print(f"{row}, seed {seed}, {way}: {deliver(policy, see)}", flush=True)


if __name__ == "__main__":
    command, *rest = sys.argv[1:] or sys.exit(__doc__)
    if command == "compare":
        compare(*rest)
    elif command == "play":
        play(rest[0], *map(int, rest[1:]))
    else:
        record(Path(command), *map(int, rest))
