"""Laws of weather: how fast it falls, how large and how many its particles are, how wind meets the ground."""
