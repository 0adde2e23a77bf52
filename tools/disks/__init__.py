"""Commands on disks that fail, as try_failing_disks.py and a sample in the tests run them."""
