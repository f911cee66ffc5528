## Names that avatars give to their shapes. The table is shared/face/shape_names.txt, and
## shared/face/shape_names.py explains it.
class_name KouxingShapeNames

const TABLE := """
arkit *jawOpen=mouthOpen jawForward jawLeft jawRight mouthClose mouthLeft mouthRight tongueOut
 *mouthPucker=Mouth_Pucker_Up_L+Mouth_Pucker_Up_R+Mouth_Pucker_Down_L+Mouth_Pucker_Down_R
 mouthFunnel=Mouth_Funnel_Up_L+Mouth_Funnel_Up_R+Mouth_Funnel_Down_L+Mouth_Funnel_Down_R
 mouthRollLower=Mouth_Roll_In_Lower_L+Mouth_Roll_In_Lower_R mouthShrugLower mouthShrugUpper
 mouthRollUpper=Mouth_Roll_In_Upper_L+Mouth_Roll_In_Upper_R mouthPressLeft mouthPressRight
 mouthLowerDownLeft=Mouth_Down_Lower_L mouthLowerDownRight=Mouth_Down_Lower_R
 mouthUpperUpLeft=Mouth_Up_Upper_L mouthUpperUpRight=Mouth_Up_Upper_R
 mouthSmileLeft mouthSmileRight mouthFrownLeft mouthFrownRight mouthDimpleLeft
 mouthDimpleRight mouthStretchLeft mouthStretchRight noseSneerLeft noseSneerRight
 browInnerUp=Brow_Raise_Inner_L+Brow_Raise_Inner_R cheekPuff=Cheek_Puff_L+Cheek_Puff_R
 browOuterUpLeft=Brow_Raise_Outer_L browOuterUpRight=Brow_Raise_Outer_R
 browDownLeft=Brow_Drop_L browDownRight=Brow_Drop_R
 cheekSquintLeft=Cheek_Raise_L cheekSquintRight=Cheek_Raise_R
 eyeBlinkLeft=Eyes_Closed_L eyeBlinkRight=Eyes_Closed_R
 eyeSquintLeft eyeSquintRight eyeWideLeft eyeWideRight
 eyeLookUpLeft=Eye_L_Look_Up eyeLookUpRight=Eye_R_Look_Up
 eyeLookDownLeft=Eye_L_Look_Down eyeLookDownRight=Eye_R_Look_Down
 eyeLookInLeft=Eye_L_Look_R eyeLookInRight=Eye_R_Look_L
 eyeLookOutLeft=Eye_L_Look_L eyeLookOutRight=Eye_R_Look_R
oculus *aa=V_Open=vAA *PP=V_Explosive=vM FF=V_Dental_Lip=vF TH=vTH DD=V_Tongue_Up=vT kk=vK
 CH=V_Affricate=vSH SS=vS nn=vL RR=vER sil E=viseme_E=v_E=vEH
 *ih=viseme_I=V_Wide=vIH *oh=viseme_O=V_Tight_O=vOW *ou=viseme_U=V_Tight=vUW
vrm *aa=A=MTH_A=Mouth_A=Vowel_A=Lip_A=Ah=あ=ア=ｱ *ih=I=MTH_I=Mouth_I=Vowel_I=Lip_I=い=イ=ｲ
 *ou=U=MTH_U=Mouth_U=Vowel_U=Lip_U=Oo=う=ウ=ｳ *ee=E=MTH_E=Mouth_E=Vowel_E=Lip_E=Eh=え=エ=ｴ
 *oh=O=MTH_O=Mouth_O=Vowel_O=Lip_O=お=オ=ｵ blink=EYE_Close=EYE_DEF_C=Eyes_Closed=まばたき=瞬き
 blinkLeft=EYE_Close_L=Wink_L=ウィンク２=ウィンク2=ｳｨﾝｸ２=ｳｨﾝｸ2=ウィンク=ウインク=ｳｨﾝｸ
 blinkRight=EYE_Close_R=Wink_R=ウィンク２右=ウィンク2右=ｳｨﾝｸ２右=ｳｨﾝｸ2右=ウィンク右=ウインク右=ｳｨﾝｸ右
 lookUp lookDown lookLeft lookRight
"""
const TITLES := {"arkit": "ARKit", "oculus": "Oculus", "vrm": "VRM"}

static var _separator := RegEx.create_from_string("[._:|/\\- ]|eCTRL|(?<=[a-z])(?=[A-Z])")
static var _number := RegEx.create_from_string("[._ ](div)?\\d+$")  # .001 of Blender, _div2 of Daz
static var _left := RegEx.create_from_string("([._\\- ][Ll]|(?<=[a-z])L)$")
static var _right := RegEx.create_from_string("([._\\- ][Rr]|(?<=[a-z])R)$")
static var _sets := _read_table()


## Return the shape of each recognized name of a mesh, by name.
static func find_shapes(set_name: String, names: Array) -> Dictionary:
	var known := {}
	for entry: Dictionary in _sets[set_name]:
		for parts: Array in entry["choices"]:
			for key: String in parts:
				known[key] = true
	var by_key := {}
	for name: String in names:
		for key: String in _candidates(name):
			if known.has(key):
				if not by_key.has(key):
					by_key[key] = name
				break
	var shapes := {}
	for entry: Dictionary in _sets[set_name]:
		for parts: Array in entry["choices"]:
			var present := parts.filter(func(key: String) -> bool: return by_key.has(key))
			for key: String in present:
				shapes[by_key[key]] = entry["shape"]
			if not present.is_empty():
				break
	return shapes


## Return [set, ""] for the set that moves an avatar with these names, or ["", the reason]. The set
## is the first that is complete, or the nearest to that.
static func choose_set(names: Array) -> Array:
	var missing := {}
	var share := {}
	var speaking := []
	for set_name: String in _sets:
		var found := find_shapes(set_name, names).values()
		var needed := []
		for entry: Dictionary in _sets[set_name]:
			if entry["is_needed"]:
				needed.append(entry["shape"])
		missing[set_name] = needed.filter(func(shape: String) -> bool: return not shape in found)
		# between equals, the number of known names decides
		share[set_name] = float(missing[set_name].size()) / needed.size() - found.size() / 1000.0
		if needed[0] in found:
			speaking.append(set_name)
	for set_name: String in speaking:
		if missing[set_name].is_empty():
			return [set_name, ""]
	speaking.reverse()
	var nearest := _nearest(share, speaking if speaking else share.keys())
	if speaking:
		return [nearest, ""]
	var text := (
		"the avatar cannot speak: it has no shape %s of %s; "
		+ "use an avatar with the shapes of ARKit, Oculus or VRM"
	)
	return ["", text % [", ".join(PackedStringArray(missing[nearest])), TITLES[nearest]]]


static func _nearest(share: Dictionary, set_names: Array) -> String:
	var best: String = set_names[0]
	for set_name: String in set_names:
		if share[set_name] < share[best]:
			best = set_name
	return best


## Remove a number at the end of a name, and write the side before it as a word.
static func _sided(name: String) -> String:
	return _right.sub(_left.sub(_number.sub(name, ""), "Left"), "Right")


static func _to_key(name: String) -> String:
	return _separator.sub(name, "", true).to_lower()


## Return the keys of a name without none, one, two, ... words at its beginning.
static func _candidates(name: String) -> Array:
	var text := _sided(name)
	var keys := [_to_key(text)]
	for separator in _separator.search_all(text):
		var key := _to_key(text.substr(separator.get_end()))
		var mark := separator.get_string()
		if key.length() > (1 if mark else 6) or (mark and mark in ".:|/"):
			keys.append(key)
	return keys


static func _read_table() -> Dictionary:
	var sets := {}
	var set_name := ""
	for line in TABLE.strip_edges().split("\n"):
		var words := Array(line.strip_edges().split(" "))
		if not line.begins_with(" "):
			set_name = words.pop_front()
			sets[set_name] = []
		for word: String in words:
			var choices := Array(word.trim_prefix("*").split("="))
			(
				sets[set_name]
				. append(
					{
						"shape": choices[0],
						"is_needed": word.begins_with("*"),
						"choices": choices.map(_to_keys),
					}
				)
			)
	return sets


static func _to_keys(parts: String) -> Array:
	return Array(parts.split("+")).map(func(part: String) -> String: return _to_key(_sided(part)))
