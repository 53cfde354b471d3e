"""The evaluation harness: protocols, metrics, and one way to run them."""
