"""Hands on to the commands what they say when they cannot do what was asked."""

from pgsd_nerfstudio.refusal import Refusal, refusing

__all__ = ["Refusal", "refusing"]
