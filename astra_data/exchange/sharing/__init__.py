"""Datasets shared: a card that says what one is, and versions sent to the Hub or any storage and back.

Every place holds the dataset's own files and beside them SHA256SUMS, which lists them all; the card
(README.md and its figure) is for readers and never fetched.

hf://datasets/<user>/<name>             on the Hugging Face Hub: one repository, a tag data-<version> each
<url>/<name>/data-<version>/            anywhere else: s3, gs, file and whatever fsspec knows
"""
