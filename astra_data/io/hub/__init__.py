"""Sharing of datasets: their cards, and push and pull to the Hugging Face Hub or any storage.

Every place holds the dataset's own files and SHA256SUMS, which lists them all. The card (README.md and its
figure) is for readers and is not downloaded.

hf://datasets/<user>/<name>             on the Hugging Face Hub: one repository, a tag data-<version> each
<url>/<name>/data-<version>/            anywhere else: s3, gs, file and whatever fsspec knows
"""
