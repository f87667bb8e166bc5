"""The display server: a bench file to its parts; frames paced, drawn, shown and recorded; the
console.
"""
