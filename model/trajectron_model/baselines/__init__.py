"""Predictors to be judged beside the model, on the same windows; `registry` has them by name."""
