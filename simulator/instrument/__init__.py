"""What a board adds to noise-free frames: the AD5940's signal chain and its drift."""
