"""The Trajectron: probabilistic trajectories of many agents from a dynamic spatiotemporal graph."""
