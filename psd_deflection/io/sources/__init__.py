"""Where samples come from: one file a device, one interface, a registry that plug-ins join."""
