"""Mathematics of Intrinsic Image Fusion: arrays in, arrays out; opens no file, picks no device."""
