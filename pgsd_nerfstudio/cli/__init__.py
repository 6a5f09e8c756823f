"""The commands of `pgsd`, one a module. Training and viewing are nerfstudio's."""
