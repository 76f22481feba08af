"""Locomotion policies (stage 4): tasks, environments, training, trained policies, deployment."""
