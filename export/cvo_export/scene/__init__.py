"""A virtual room and a camera in it.

renderer    renders textured rectangles exactly, from any pose; independent of the room
paint       the room's textures
room        walls and furniture as faces for the renderer
sensor      motion blur, light and noise of a real camera
"""
