"""Recordings of others as raw logs: their measurements in the bytes that our sensors would have sent."""
