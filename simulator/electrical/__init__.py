"""The complete electrode model: from a conductivity to the impedances between electrodes."""
