"""The nerfstudio method `pgsd-weather`: the only room that knows nerfstudio. `plugin.config` holds the entry point."""
