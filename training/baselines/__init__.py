"""Baselines: methods of a page each, to compare others with.

Tables of features and targets, by ridge regression, a network or trees; and centroids of pictures.
"""
