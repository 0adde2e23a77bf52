"""Options that are the settings of a stage, made from its config model: one per field.

The model is imported only when its command is called or helps, so that `astra-data --help` answers at once.
"""
