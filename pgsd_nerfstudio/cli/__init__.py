"""The commands of `pgsd`: preview, simulate, doctor, cache, bench and verify. Training and viewing are nerfstudio's."""
