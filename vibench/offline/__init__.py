"""The offline phase as an object, and the reduced model that it ends in; usable without a study."""
