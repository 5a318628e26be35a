"""The loads of a recording as they acted, by the motion: when each began, what hung, what a load cell measured."""
