"""The joint method: bend and touches estimated together by fitting a learned sensor model."""
