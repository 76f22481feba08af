"""Stage 4, policies: tasks, environments, trained policies, deployment."""
