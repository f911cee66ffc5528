## Moves a face with a live session. Godot 4: add this script to a node and choose the face in the
## inspector. It moves every mesh below the face that has blendshapes of ARKit, Oculus or VRM, also
## under the names of other programs.
extends Node

const RETRY_MS := 1000

@export var gateway := "ws://127.0.0.1:8080"
## Session to follow; if empty, the newest.
@export var session := ""
@export var face: Node3D

var _socket := WebSocketPeer.new()
var _retry_at_ms := 0
var _set := ""
var _targets := {}  # [mesh, index] of the blendshapes, lists by shape


func _ready() -> void:
	var names_of := {}
	for mesh: MeshInstance3D in face.find_children("*", "MeshInstance3D", true, false):
		names_of[mesh] = range(mesh.get_blend_shape_count()).map(
			func(index: int) -> String: return mesh.mesh.get_blend_shape_name(index)
		)
	var all_names := []
	for names: Array in names_of.values():
		all_names.append_array(names)
	var chosen := KouxingShapeNames.choose_set(all_names)
	_set = chosen[0]
	if _set == "":
		push_error("kouxing: " + chosen[1])
		set_process(false)
		return
	for mesh: MeshInstance3D in names_of:
		var shapes := KouxingShapeNames.find_shapes(_set, names_of[mesh])
		for target: String in shapes:
			var targets: Array = _targets.get(shapes[target], [])
			targets.append([mesh, names_of[mesh].find(target)])
			_targets[shapes[target]] = targets


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
				var query := "?shapes=%s&format=json&session=%s" % [_set, session.uri_encode()]
				_socket.connect_to_url(gateway + "/viewer" + query)


## Show a face of the session or at rest; ignore other messages.
func _receive(message: Dictionary) -> void:
	if message["type"] == "error":
		push_warning("kouxing: " + message["text"])
	if message["type"] not in ["weights", "rest"]:
		return
	for shape: String in message["weights"]:
		for target: Array in _targets.get(shape, []):
			target[0].set_blend_shape_value(target[1], message["weights"][shape])
