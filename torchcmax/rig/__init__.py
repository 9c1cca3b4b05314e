"""The motor rig: planned motions of one to three axes on CANopen drives, and ground truth of them.  Imports nothing of the rest."""
