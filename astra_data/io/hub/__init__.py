"""Sharing of datasets: their cards, and push and pull to the Hugging Face Hub or any storage.

A place holds a dataset's files and SHA256SUMS, which lists them: a repository of the Hub, with a tag data-<version>
each, or <url>/<name>/data-<version>/ on s3, gs, file and whatever fsspec knows. Cards are not downloaded.
"""
