"""The physics process: rigid bodies behind the protocol; it knows mesh and drone parameters, but no task."""
