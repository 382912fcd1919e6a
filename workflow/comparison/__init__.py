"""What is put side by side: two results, and anyone's maps beside a scene with truth."""
