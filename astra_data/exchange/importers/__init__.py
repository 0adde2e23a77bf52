"""Other people's logs, one file per format; no file knows another.

Each has `read(source, mapping)`, which yields `recording.Block`s with the fields that `mapping` names, and
those whose fields have standard names have `layout(source)`, which returns a mapping's keys. What goes wrong
in reading may be any exception of the libraries that read: `imports` explains it.
"""
