class_name MapctlReceiver
extends Node
## Poses a Skeleton3D of Godot 4.2 or later by the stream of `mapctl live` or
## `mapctl steer --realtime` (docs/guides/engines.md).
##
## Bones have the names of SkeletonProfileHumanoid, and the rest pose is a T-pose that faces +Z.

## Parent of each streamed bone, parents first.
const PARENTS := {
	"Hips": "",
	"Spine": "Hips",
	"Chest": "Spine",
	"Neck": "Chest",
	"Head": "Neck",
	"LeftShoulder": "Chest",
	"LeftUpperArm": "LeftShoulder",
	"LeftLowerArm": "LeftUpperArm",
	"LeftHand": "LeftLowerArm",
	"RightShoulder": "Chest",
	"RightUpperArm": "RightShoulder",
	"RightLowerArm": "RightUpperArm",
	"RightHand": "RightLowerArm",
	"LeftUpperLeg": "Hips",
	"LeftLowerLeg": "LeftUpperLeg",
	"LeftFoot": "LeftLowerLeg",
	"LeftToes": "LeftFoot",
	"RightUpperLeg": "Hips",
	"RightLowerLeg": "RightUpperLeg",
	"RightFoot": "RightLowerLeg",
	"RightToes": "RightFoot",
}

@export var port := 39539
@export var skeleton: Skeleton3D

## Whether the left and the right toe stand.
var planted := [false, false]
## Velocity of the hips over the ground, m/s.
var root_velocity := Vector3.ZERO

var _socket := PacketPeerUDP.new()
var _bones := {}  # Transform3D by name, of the frame that arrives; "" is the root
var _frame := -1.0  # its time, which opens each of its packets


func _ready() -> void:
	if _socket.bind(port) != OK:
		push_error("port %d is taken" % port)


func _process(_delta: float) -> void:
	while _socket.get_available_packet_count() > 0:
		_read_packet(_socket.get_packet())


## Reads an OSC packet: a message, or a bundle of them.
func _read_packet(bytes: PackedByteArray) -> void:
	if bytes.slice(0, 7).get_string_from_ascii() != "#bundle":
		_read_message(bytes)
		return
	var at := 16  # after the name and the time of the bundle
	while at + 4 <= bytes.size():
		var size := _read_stream(bytes, at).get_32()
		if size <= 0 or at + 4 + size > bytes.size():
			return
		_read_packet(bytes.slice(at + 4, at + 4 + size))
		at += 4 + size


func _read_message(bytes: PackedByteArray) -> void:
	var address := _read_text(bytes, 0)
	var at := _skip_text(address, 0)
	var tags := _read_text(bytes, at)
	at = _skip_text(tags, at)
	var values := []
	for tag in tags.substr(1):
		if tag == "s":
			values.append(_read_text(bytes, at))
			at = _skip_text(values[-1], at)
		elif tag in ["f", "i"] and at + 4 <= bytes.size():
			var stream := _read_stream(bytes, at)
			values.append(stream.get_float() if tag == "f" else float(stream.get_32()))
			at += 4
		else:
			return
	_take(address, tags, values)


func _take(address: String, tags: String, values: Array) -> void:
	match [address, tags]:
		["/mapctl/frame", ",f"]:
			if values[0] != _frame:  # bones of a frame that has lost a packet are left out
				_bones.clear()
				_frame = values[0]
		["/VMC/Ext/Root/Pos", ",sfffffff"]:
			_bones[""] = _read_transform(values)
		["/VMC/Ext/Bone/Pos", ",sfffffff"]:
			_bones[values[0]] = _read_transform(values)
		["/mapctl/contacts", ",ff"]:
			planted = [values[0] > 0.5, values[1] > 0.5]
		["/mapctl/root_velocity", ",ff"]:
			root_velocity = Vector3(values[0], 0.0, values[1])
		["/VMC/Ext/T", ",f"]:
			if _bones.has_all(PARENTS.keys()):
				_pose()
			_bones.clear()


## Godot's axes are right-handed and the protocol's left-handed: x is reversed.
func _read_transform(values: Array) -> Transform3D:
	var turn := Quaternion(values[4], -values[5], -values[6], values[7]).normalized()
	return Transform3D(Basis(turn), Vector3(-values[1], values[2], values[3]))


func _pose() -> void:
	var turned := {"": Quaternion.IDENTITY}  # each bone from the T-pose, in the skeleton's space
	var driver := {"": ""}  # the bone that the skeleton has for it: its own, or the nearest above it
	for bone: String in PARENTS:
		turned[bone] = turned[PARENTS[bone]] * _bones[bone].basis.get_rotation_quaternion()
		var index := skeleton.find_bone(bone)
		driver[bone] = driver[PARENTS[bone]] if index < 0 else bone
		if index < 0:
			continue
		var above := _rest(skeleton.get_bone_parent(index))
		var parent: Quaternion = (
			turned[driver[PARENTS[bone]]] * above.basis.get_rotation_quaternion()
		)
		var own: Quaternion = turned[bone] * _rest(index).basis.get_rotation_quaternion()
		skeleton.set_bone_pose_rotation(index, parent.inverse() * own)
		if bone == "Hips":
			var hips: Vector3 = _bones[bone].origin * _scale()
			skeleton.set_bone_pose_position(index, above.affine_inverse() * hips)
	if _bones.has(""):
		skeleton.transform = _bones[""]


## Length of the skeleton's leg over that of the streamed one, so that its feet reach the ground.
func _scale() -> float:
	var streamed: float = (
		_bones["LeftLowerLeg"].origin.length() + _bones["LeftFoot"].origin.length()
	)
	var hip := _rest(skeleton.find_bone("LeftUpperLeg")).origin
	var knee := _rest(skeleton.find_bone("LeftLowerLeg")).origin
	var ankle := _rest(skeleton.find_bone("LeftFoot")).origin
	return (hip.distance_to(knee) + knee.distance_to(ankle)) / streamed


func _rest(index: int) -> Transform3D:
	return skeleton.get_bone_global_rest(index) if index >= 0 else Transform3D.IDENTITY


func _read_stream(bytes: PackedByteArray, at: int) -> StreamPeerBuffer:
	var stream := StreamPeerBuffer.new()
	stream.big_endian = true
	stream.data_array = bytes
	stream.seek(at)
	return stream


func _read_text(bytes: PackedByteArray, at: int) -> String:
	var end := bytes.find(0, at)
	return bytes.slice(at, end).get_string_from_ascii() if end >= at else ""


## Texts end with a zero and fill words of four bytes.
func _skip_text(text: String, at: int) -> int:
	return at + (text.length() / 4 + 1) * 4
