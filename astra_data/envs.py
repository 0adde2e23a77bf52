"""`import astra_data.envs` registers the Gymnasium ids; see `astra_data.pipeline.gymnasium_ids`."""

from astra_data.pipeline import gymnasium_ids as gymnasium_ids
