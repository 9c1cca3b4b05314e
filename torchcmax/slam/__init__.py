"""Tracking and mapping: windows of events in, poses and a map out."""
