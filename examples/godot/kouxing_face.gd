## Moves a face with a live session. Godot 4: add this script to a node and choose the face in the
## inspector. It moves every mesh below the face that has blend shapes with ARKit's names.
extends Node

const RETRY_MS := 1000

@export var gateway := "ws://127.0.0.1:8080"
## Session to follow; if empty, the newest.
@export var session := ""
@export var face: Node3D

var _socket := WebSocketPeer.new()
var _retry_at_ms := 0
var _meshes: Array[Node] = []


func _ready() -> void:
	_meshes = face.find_children("*", "MeshInstance3D", true, false)


func _process(_delta: float) -> void:
	_socket.poll()
	match _socket.get_ready_state():
		WebSocketPeer.STATE_OPEN:
			while _socket.get_available_packet_count() > 0:
				var packet := _socket.get_packet()
				if _socket.was_string_packet():
					_receive(JSON.parse_string(packet.get_string_from_utf8()))
		WebSocketPeer.STATE_CLOSED:
			if Time.get_ticks_msec() >= _retry_at_ms:
				_retry_at_ms = Time.get_ticks_msec() + RETRY_MS
				var query := "?shapes=arkit&format=json&session=" + session.uri_encode()
				_socket.connect_to_url(gateway + "/viewer" + query)


## Show a face of the session or at rest; ignore other messages.
func _receive(message: Dictionary) -> void:
	if message["type"] == "error":
		push_warning("kouxing: " + message["text"])
	if message["type"] not in ["weights", "rest"]:
		return
	for mesh: MeshInstance3D in _meshes:
		for shape: String in message["weights"]:
			var index := mesh.find_blend_shape_by_name(shape)
			if index >= 0:
				mesh.set_blend_shape_value(index, message["weights"][shape])
