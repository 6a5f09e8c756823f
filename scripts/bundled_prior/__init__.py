"""What `scripts/train_bundled_prior.py` is made of: clips, captions, nets, the two trainings, and their judge."""
