"""How a level learns from what it did: PPO, TD3, and what they share."""
