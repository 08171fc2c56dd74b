"""Recognition of classes from fitted coefficients: training, prediction, evaluation."""
