"""The smallest recipe of a humanoid that uses the target, a grounding and the stages up to the evaluation."""

RECIPE = """
task = "humanoid-walker2d"
methods = ["direct_transfer", "astra"]
seeds = [0]

[collect]
episodes = 8
max_steps = 40
start = "task"
hold_s = [0.03, 0.2]

[ground]
updates = 3
batch_windows = 4
window = 20
latent_size = 8
held_out_share = 0.25

[train]
num_envs = 8
rollout_steps = 16
total_steps = 256
hidden_sizes = [8]
memory_size = 8
tries = 1

[align]
updates = 3
batch_windows = 4
window = 20

[evaluate]
episodes = 3

"""
