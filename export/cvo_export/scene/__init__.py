"""Virtual places and cameras in them.

renderer      renders textured rectangles exactly, from any pose; independent of the places
paint         textures of materials and objects
paint_street  textures of houses, ground, cars and sky
boxes         boxes as faces for the renderer
room          walls and furniture
street        a street round a block of houses
sensor        motion blur, light and noise of a real camera
recording     one recording: poses and photographs over time
flight        recordings in the room
drive         recordings in the street
"""
