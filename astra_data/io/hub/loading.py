"""The section of a dataset card on loading the dataset."""

import json

from astra_data.dataset.columns import STATE
from astra_data.dataset.reader import Dataset
from astra_data.io.hub.address import Hub, parse_source


def loading(dataset: Dataset, source: str | None) -> str:
    """Return the card's section on loading: with lerobot, with datasets and with astra-data.

    Args:
        dataset: the one that the card describes.
        source: where it is shared; None if it is only in a local folder.
    """
    name, tag = dataset.description["name"], f"data-{dataset.description['version']}"
    place = None if source is None else parse_source(source)[0]
    if isinstance(place, Hub):
        lerobot = f'LeRobotDataset("{place.repo}", revision="{tag}")'
        rows = f'load_dataset("{place.repo}", revision="{tag}", split="train")'
        root = ""
    else:
        root = f'root = "datasets/{name}/{tag}"\n'
        lerobot = f'LeRobotDataset("{name}", root=root)'
        rows = 'load_dataset("parquet", data_files=f"{root}/data/*/*.parquet", split="train")'
    column = STATE if STATE in dataset.features else dataset.schema[0].name
    fetched = (
        f"```sh\nastra-data pull {source} --version {dataset.description['version']}\n```\n\n"
        if source
        else ""
    )
    return f"""\
{fetched}```python
from astra_data.dataset.versions import open_dataset

values = open_dataset("{dataset.reference}").columns([{json.dumps(column)}])
```

With [LeRobot](https://github.com/huggingface/lerobot):

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

{root}dataset = {lerobot}
```

With [datasets](https://github.com/huggingface/datasets):

```python
from datasets import load_dataset

{root}rows = {rows}
```"""
