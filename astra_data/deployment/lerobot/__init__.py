"""A policy and an environment for LeRobot's own tools, which import this package by its name.

configuration_astra_data    the policy's settings, registered as `astra_data`
modeling_astra_data         the policy: what `astra-data deploy` wrote
environment                 the target of a task, registered as `astra_data`

    lerobot-eval --env.discover_packages_path=astra_data.deployment.lerobot \
        --env.type=astra_data --env.task=antmaze-umaze --policy.path=policy

LeRobot derives the names of modules and classes from that of the configuration.
"""
