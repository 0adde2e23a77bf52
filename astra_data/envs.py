"""Gymnasium ids of targets, of abstract simulators and of what a run grounded, registered on import.

    import astra_data.envs
    gymnasium.make("astra_data/AntMazeUMaze-v0")
    gymnasium.make_vec("astra_data/AntMazeUMaze-v0", num_envs=64)
    gymnasium.make("astra_data/Grounded-v0", run="runs/cart", row="nas", seed=0)

Everything else stays unloaded until an environment is made.
"""

from astra_data.core.errors import optional

gymnasium = optional("gymnasium")

_FACES = "astra_data.policies.gymnasium"
_GROUNDED = "astra_data.pipeline.grounded_env"

for _maze, _task, _horizon in (("UMaze", "antmaze-umaze", 700), ("Long", "antmaze-long", 1000)):
    for _world in ("AntMaze", "PointMaze"):
        gymnasium.register(
            f"astra_data/{_world}{_maze}-v0",
            entry_point=f"{_FACES}:maze",
            vector_entry_point=f"{_FACES}:maze_vector",
            max_episode_steps=_horizon,
            kwargs={"task": _task, "in_target": _world == "AntMaze"},
        )

gymnasium.register(
    "astra_data/Grounded-v0", entry_point=f"{_GROUNDED}:grounded", vector_entry_point=f"{_GROUNDED}:grounded_vector"
)
