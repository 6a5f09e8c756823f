"""The commands of `pgsd`: preview, simulate, path, render, doctor, cache, bench, verify. Training and viewing are nerfstudio's."""
