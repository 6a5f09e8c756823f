"""The motion prior of the paper: MPM throughout, in a unit cube, with the published numbers and their artefacts."""

from pgsd_nerfstudio.physics.paper.config import PAPER_EFFECTS, PaperConfig, paper_config
from pgsd_nerfstudio.physics.paper.run import simulate_paper
from pgsd_nerfstudio.physics.paper.solver import Box, PaperSolver

__all__ = ["PAPER_EFFECTS", "Box", "PaperConfig", "PaperSolver", "paper_config", "simulate_paper"]
