"""`import astra_data.envs` registers the Gymnasium ids; see `astra_data.experiments.gymnasium_ids`."""

from astra_data.experiments import gymnasium_ids as gymnasium_ids
