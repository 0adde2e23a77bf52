"""What a roboticist should know of her logs before she grounds a simulator with them.

`doctor` is for datasets that are broken; these are whole, and what is found here is no error.
"""
