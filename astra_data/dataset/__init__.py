"""Datasets on disk: LeRobot v3.0, written atomically, read without torch or lerobot.

<root>/meta/info.json  stats.json  tasks.parquet  episodes/chunk-000/file-000.parquet
<root>/data/chunk-000/file-000.parquet          one row group per episode
<root>/meta/astra/dataset.json                  provenance, content hash, sums of the small files
<root>/meta/astra/episodes.parquet              one row of metadata per episode, keyed by episode_uid
<root>/meta/astra/subsets.json                  the permutation whose prefixes are the nested subsets
<root>/meta/astra/digests.parquet              one digest of the values per episode and column
<root>/meta/astra/policy.safetensors            the policy that acted, if it was trained while collecting

For training, `frames.Frames` holds columns as tensors and draws windows and transitions.
"""

from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter, StagedWriter

__all__ = ["Dataset", "DatasetWriter", "StagedWriter"]
