## Moves a face with a live session. Godot 4: add this script to a node and choose the face in the
## inspector. It moves every mesh below the face that has blendshapes of ARKit, Oculus or VRM, also
## under the names of other programs.
extends Node

const RETRY_MS := 1000

@export var gateway := "ws://127.0.0.1:8080"
## Session to follow; if empty, the newest.
@export var session := ""
## The gateway's token, if it requires one.
@export var token := ""
## The gateway's certificate, if it is self-signed.
@export var certificate: X509Certificate
@export var face: Node3D

var _socket := WebSocketPeer.new()
var _is_open := false
var _retry_at_ms := 0
var _meshes := []
var _targets := []  # the mesh and the index of the blendshape that each weight moves


func _ready() -> void:
	_meshes = face.find_children("*", "MeshInstance3D", true, false)


func _process(_delta: float) -> void:
	_socket.poll()
	match _socket.get_ready_state():
		WebSocketPeer.STATE_OPEN:
			if not _is_open:
				_is_open = true
				_socket.send_text(JSON.stringify({"avatar": _meshes.map(_names), "format": "json"}))
			while _socket.get_available_packet_count() > 0:
				var packet := _socket.get_packet()
				if _socket.was_string_packet():
					_receive(JSON.parse_string(packet.get_string_from_utf8()))
		WebSocketPeer.STATE_CLOSED:
			_is_open = false
			if Time.get_ticks_msec() >= _retry_at_ms:
				_retry_at_ms = Time.get_ticks_msec() + RETRY_MS
				var query := "?session=" + session.uri_encode() + "&token=" + token.uri_encode()
				var url := gateway.trim_suffix("/") + "/viewer" + query
				_socket.connect_to_url(url, TLSOptions.client(certificate))


## Return the names of a mesh's blendshapes.
func _names(mesh: MeshInstance3D) -> Array:
	return range(mesh.get_blend_shape_count()).map(
		func(index: int) -> String: return mesh.mesh.get_blend_shape_name(index)
	)


## Show a face of the session or at rest; ignore other messages.
func _receive(message: Dictionary) -> void:
	match message["type"]:
		"error":
			push_warning("kouxing: " + message["text"])
		"avatar":
			_targets = message["targets"]
		"weights", "rest":
			for index in range(_targets.size()):
				var target: Array = _targets[index]
				var mesh: MeshInstance3D = _meshes[int(target[0])]
				mesh.set_blend_shape_value(int(target[1]), message["weights"][index])
