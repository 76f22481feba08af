"""Proximal policy optimization (PPO): networks, training loop, and training in several processes."""
