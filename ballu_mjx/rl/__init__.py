"""PPO: networks, the learning loop, several processes."""
