"""Live accuracy: the service scores its own forecasts when the future arrives."""
