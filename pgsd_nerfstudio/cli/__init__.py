"""The commands of `pgsd`: preview, simulate, bench and verify. Training and viewing are nerfstudio's."""
