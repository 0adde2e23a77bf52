"""`import astra_data.envs` registers the Gymnasium ids; see `astra_data.training.gymnasium_ids`."""

from astra_data.training import gymnasium_ids as gymnasium_ids
