"""The agent: sensors, observation, actions, reward, policies, training, and the inference loop."""
