"""What a sensor is: its outline, thickness and electrodes, and the areas that these contact."""
