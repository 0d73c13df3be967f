"""Recordings of any board and skin: file readers, and their conversion to datasets."""
