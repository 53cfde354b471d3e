"""Simple predictors to be judged beside the model, on the same windows."""
