"""Stage 5: how well a simulator predicts, and how well a policy transfers."""
