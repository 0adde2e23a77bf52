"""Readers of logs, one file per format, independent of each other.

Each has `read(source, mapping)`, which yields `recording.Block`s with the fields that `mapping` names. Formats whose
fields have standard names also have `layout(source)`, which returns the keys of a mapping. All may raise any exception
of the libraries that they read with; `importing` turns it into a message.
"""
