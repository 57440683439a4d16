"""The virtual rig: a scripted experiment on a body that is not the estimator's, seen by a camera with noise."""
