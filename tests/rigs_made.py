"""Made rigs: how common programs and devices name and nest their joints. Names are facts; the bodies are ours."""

import re

import torch

from motionlab.skeleton import STANDARD, Skeleton

#: Per family: trunk, neck and head; legs; arms (``{S}`` Left, ``{s}`` left, ``{L}`` L, ``{l}`` l of the side; ``-``:
#: the rig lacks it); then more joints: ``a<b`` hangs on b, ``a>b`` stands between b and what b hung on.
#: Sketchfab numbers Mixamo's names in GLB; thighs on the spine are what 3ds Max calls its triangle of the pelvis.
_TEXT = """
SMPL = Pelvis Spine1 Spine2 Spine3 Neck Head / {L}_Hip {L}_Knee {L}_Ankle {L}_Foot
    / {L}_Collar {L}_Shoulder {L}_Elbow {L}_Wrist / {L}_Hand<{L}_Wrist
SMPL long = m_avg_Pelvis m_avg_Spine1 m_avg_Spine2 m_avg_Spine3 m_avg_Neck m_avg_Head
    / m_avg_{L}_Hip m_avg_{L}_Knee m_avg_{L}_Ankle m_avg_{L}_Foot
    / m_avg_{L}_Collar m_avg_{L}_Shoulder m_avg_{L}_Elbow m_avg_{L}_Wrist
    / m_avg_root>m_avg_Pelvis m_avg_{L}_Hand<m_avg_{L}_Wrist
Mixamo = mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Spine2 mixamorig:Neck mixamorig:Head
    / mixamorig:{S}UpLeg mixamorig:{S}Leg mixamorig:{S}Foot mixamorig:{S}ToeBase
    / mixamorig:{S}Shoulder mixamorig:{S}Arm mixamorig:{S}ForeArm mixamorig:{S}Hand
    / mixamorig:{S}HandIndex1<mixamorig:{S}Hand mixamorig:{S}Toe_End<mixamorig:{S}ToeBase
    mixamorig:HeadTop_End<mixamorig:Head
Mixamo numbered = mixamorig:Hips_01 mixamorig:Spine_02 mixamorig:Spine1_03 mixamorig:Spine2_04 mixamorig:Neck_05
    mixamorig:Head_06
    / mixamorig:{S}UpLeg_055 mixamorig:{S}Leg_056 mixamorig:{S}Foot_057 mixamorig:{S}ToeBase_058
    / mixamorig:{S}Shoulder_08 mixamorig:{S}Arm_09 mixamorig:{S}ForeArm_010 mixamorig:{S}Hand_011
    / _rootJoint>mixamorig:Hips_01
CMU ASF = root lowerback upperback thorax lowerneck head / {l}femur {l}tibia {l}foot {l}toes
    / {l}clavicle {l}humerus {l}radius {l}wrist
    / {l}hipjoint>{l}femur upperneck>head {l}hand<{l}wrist {l}fingers<{l}hand {l}thumb<{l}hand
CMU BVH = Hips LowerBack Spine Spine1 Neck Head / {S}UpLeg {S}Leg {S}Foot {S}ToeBase
    / {S}Shoulder {S}Arm {S}ForeArm {S}Hand
    / {L}HipJoint>{S}UpLeg Neck1>Head {S}FingerBase<{S}Hand {S}HandIndex1<{S}FingerBase {L}Thumb<{S}Hand
Unreal = pelvis spine_01 spine_02 spine_03 neck_01 head / thigh_{l} calf_{l} foot_{l} ball_{l}
    / clavicle_{l} upperarm_{l} lowerarm_{l} hand_{l}
    / root>pelvis thigh_twist_01_{l}<thigh_{l} calf_twist_01_{l}<calf_{l} upperarm_twist_01_{l}<upperarm_{l}
    lowerarm_twist_01_{l}<lowerarm_{l} index_01_{l}<hand_{l} ik_foot_root<root ik_foot_{l}<ik_foot_root
    ik_hand_root<root ik_hand_gun<ik_hand_root ik_hand_{l}<ik_hand_gun
Biovision = Hips Chest Chest2 Chest3 Neck Head / {S}Hip {S}Knee {S}Ankle {S}Toe
    / {S}Collar {S}Shoulder {S}Elbow {S}Wrist /
Xsens MVN = Pelvis L5 T12 T8 Neck Head / {S}UpperLeg {S}LowerLeg {S}Foot {S}Toe
    / {S}Shoulder {S}UpperArm {S}ForeArm {S}Hand / L3>T12
Poser = hip abdomen abdomen2 chest neck head / {l}Thigh {l}Shin {l}Foot {l}Toe / {l}Collar {l}Shldr {l}ForeArm {l}Hand
    / {l}Buttock>{l}Thigh {l}Thumb1<{l}Hand leftEye<head
DAZ Genesis 8 = hip abdomenLower chestLower chestUpper neckLower head / {l}ThighBend {l}Shin {l}Foot {l}Toe
    / {l}Collar {l}ShldrBend {l}ForearmBend {l}Hand
    / lThighTwist>lShin rThighTwist>rShin {l}ShldrTwist>{l}ForearmBend {l}ForearmTwist>{l}Hand neckUpper>head
    {l}Metatarsals>{l}Toe abdomenUpper>chestLower {l}Pectoral<chestLower
DAZ Genesis 9 = hip spine1 spine3 spine4 neck1 head / {l}_thigh {l}_shin {l}_foot {l}_toes
    / {l}_shoulder {l}_upperarm {l}_forearm {l}_hand
    / spine2>spine3 neck2>head {l}_metatarsals>{l}_toes {l}_thightwist1<{l}_thigh {l}_upperarmtwist1<{l}_upperarm
Second Life = mPelvis mTorso - mChest mNeck mHead / mHip{S} mKnee{S} mAnkle{S} mFoot{S}
    / mCollar{S} mShoulder{S} mElbow{S} mWrist{S}
    / mToe{S}<mFoot{S} mSkull<mHead {L}_UPPER_LEG<mHip{S} {L}_LOWER_LEG<mKnee{S} {L}_FOOT<mAnkle{S}
    {L}_UPPER_ARM<mShoulder{S} {L}_HAND<mWrist{S} HEAD<mHead PELVIS<mPelvis
Motive = Hip Ab - Chest Neck Head / {L}Thigh {L}Shin {L}Foot {L}Toe / {L}Shoulder {L}UArm {L}FArm {L}Hand /
Rokoko = Hips Spine1 Spine2 Spine3 Neck Head / {S}Thigh {S}Shin {S}Foot {S}Toe / {S}Shoulder {S}Arm {S}ForeArm {S}Hand
    / {S}ToeTip<{S}Toe {S}Finger1Metacarpal<{S}Hand
Unity = Hips Spine Chest UpperChest Neck Head / {S}UpperLeg {S}LowerLeg {S}Foot {S}Toes
    / {S}Shoulder {S}UpperArm {S}LowerArm {S}Hand / {S}Eye<Head Jaw<Head {S}ThumbProximal<{S}Hand
VRM 0 = J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head
    / J_Bip_{L}_UpperLeg J_Bip_{L}_LowerLeg J_Bip_{L}_Foot J_Bip_{L}_ToeBase
    / J_Bip_{L}_Shoulder J_Bip_{L}_UpperArm J_Bip_{L}_LowerArm J_Bip_{L}_Hand
    / Root>J_Bip_C_Hips J_Sec_{L}_Bust1<J_Bip_C_UpperChest J_Adj_{L}_FaceEye<J_Bip_C_Head
    J_Bip_{L}_Index1<J_Bip_{L}_Hand J_Sec_Hair1_01<J_Bip_C_Head
VRM 1 = hips spine chest upperChest neck head / {s}UpperLeg {s}LowerLeg {s}Foot {s}Toes
    / {s}Shoulder {s}UpperArm {s}LowerArm {s}Hand /
3ds Max Biped = Bip01_Pelvis Bip01_Spine Bip01_Spine1 Bip01_Spine2 Bip01_Neck Bip01_Head
    / Bip01_{L}_Thigh Bip01_{L}_Calf Bip01_{L}_Foot Bip01_{L}_Toe0
    / Bip01_{L}_Clavicle Bip01_{L}_UpperArm Bip01_{L}_Forearm Bip01_{L}_Hand
    / Bip01>Bip01_Pelvis Bip01_{L}_Finger0<Bip01_{L}_Hand Bip01_{L}_Toe0Nub<Bip01_{L}_Toe0 Bip01_HeadNub<Bip01_Head
    Bip01_Footsteps<Bip01
3ds Max Biped, thighs on the spine = Bip01_Spine Bip01_Spine1 - Bip01_Spine2 Bip01_Neck Bip01_Head
    / Bip01_{L}_Thigh Bip01_{L}_Calf Bip01_{L}_Foot Bip01_{L}_Toe0
    / Bip01_{L}_Clavicle Bip01_{L}_UpperArm Bip01_{L}_Forearm Bip01_{L}_Hand
    / Bip01_Pelvis>Bip01_Spine Bip01>Bip01_Pelvis Bip01_{L}_Finger0<Bip01_{L}_Hand Bip01_Footsteps<Bip01
Valve = ValveBiped.Bip01_Pelvis ValveBiped.Bip01_Spine1 ValveBiped.Bip01_Spine2 ValveBiped.Bip01_Spine4
    ValveBiped.Bip01_Neck1 ValveBiped.Bip01_Head1
    / ValveBiped.Bip01_{L}_Thigh ValveBiped.Bip01_{L}_Calf ValveBiped.Bip01_{L}_Foot ValveBiped.Bip01_{L}_Toe0
    / ValveBiped.Bip01_{L}_Clavicle ValveBiped.Bip01_{L}_UpperArm ValveBiped.Bip01_{L}_Forearm
    ValveBiped.Bip01_{L}_Hand
    / ValveBiped.Bip01_{L}_Finger1<ValveBiped.Bip01_{L}_Hand
mocopi = root torso_1 torso_4 torso_7 neck_1 head / {l}_up_leg {l}_low_leg {l}_foot {l}_toes
    / {l}_shoulder {l}_up_arm {l}_low_arm {l}_hand
    / torso_2>torso_4 torso_3>torso_4 torso_5>torso_7 torso_6>torso_7 neck_2>head
iClone = CC_Base_Hip CC_Base_Waist CC_Base_Spine01 CC_Base_Spine02 CC_Base_NeckTwist01 CC_Base_Head
    / CC_Base_{L}_Thigh CC_Base_{L}_Calf CC_Base_{L}_Foot CC_Base_{L}_ToeBase
    / CC_Base_{L}_Clavicle CC_Base_{L}_Upperarm CC_Base_{L}_Forearm CC_Base_{L}_Hand
    / RL_BoneRoot>CC_Base_Hip CC_Base_Pelvis>CC_Base_L_Thigh CC_Base_Pelvis>CC_Base_R_Thigh
    CC_Base_NeckTwist02>CC_Base_Head CC_Base_{L}_ThighTwist01<CC_Base_{L}_Thigh
    CC_Base_{L}_CalfTwist01<CC_Base_{L}_Calf CC_Base_{L}_KneeShareBone<CC_Base_{L}_Calf
    CC_Base_{L}_ToeBaseShareBone<CC_Base_{L}_Foot CC_Base_{L}_UpperarmTwist01<CC_Base_{L}_Upperarm
    CC_Base_{L}_ElbowShareBone<CC_Base_{L}_Upperarm CC_Base_FacialBone<CC_Base_Head
mGear = spine_C0_pelvis_jnt spine_C0_01_jnt spine_C0_02_jnt spine_C0_03_jnt neck_C0_01_jnt neck_C0_head_jnt
    / leg_{L}0_thigh_jnt leg_{L}0_calf_jnt leg_{L}0_foot_jnt foot_{L}0_0_jnt
    / shoulder_{L}0_shoulder_jnt arm_{L}0_upperarm_jnt arm_{L}0_lowerarm_jnt arm_{L}0_hand_jnt
    / root_C0_0_jnt>spine_C0_pelvis_jnt neck_C0_02_jnt>neck_C0_head_jnt jaw_C0_0_jnt<neck_C0_head_jnt
    arm_{L}0_upperarm_twist_01_jnt<arm_{L}0_upperarm_jnt leg_{L}0_calf_twist_01_jnt<leg_{L}0_calf_jnt
    thumb_{L}0_0_jnt<arm_{L}0_hand_jnt meta_{L}0_0_jnt<arm_{L}0_hand_jnt finger_{L}0_0_jnt<meta_{L}0_0_jnt
mGear, numbered = spine_C0_0_jnt spine_C0_1_jnt spine_C0_3_jnt spine_C0_4_jnt neck_C0_0_jnt neck_C0_head_jnt
    / leg_{L}0_0_jnt leg_{L}0_4_jnt leg_{L}0_end_jnt foot_{L}0_0_jnt
    / shoulder_{L}0_shoulder_jnt arm_{L}0_0_jnt arm_{L}0_4_jnt arm_{L}0_end_jnt
    / local_C0_root>spine_C0_0_jnt spine_C0_2_jnt>spine_C0_3_jnt neck_C0_1_jnt>neck_C0_head_jnt
    arm_{L}0_1_jnt>arm_{L}0_4_jnt arm_{L}0_2_jnt>arm_{L}0_4_jnt arm_{L}0_3_jnt>arm_{L}0_4_jnt
    arm_{L}0_5_jnt>arm_{L}0_end_jnt arm_{L}0_6_jnt>arm_{L}0_end_jnt arm_{L}0_7_jnt>arm_{L}0_end_jnt
    arm_{L}0_8_jnt>arm_{L}0_end_jnt leg_{L}0_1_jnt>leg_{L}0_4_jnt leg_{L}0_2_jnt>leg_{L}0_4_jnt
    leg_{L}0_3_jnt>leg_{L}0_4_jnt leg_{L}0_5_jnt>leg_{L}0_end_jnt leg_{L}0_6_jnt>leg_{L}0_end_jnt
    leg_{L}0_7_jnt>leg_{L}0_end_jnt leg_{L}0_8_jnt>leg_{L}0_end_jnt foot_{L}0_1_jnt<foot_{L}0_0_jnt
    thumb_{L}0_0_jnt<arm_{L}0_end_jnt
Blender, numbered = hips spine spine.001 spine.002 neck head / leg.{L} leg.{L}.001 foot.{L} toe.{L}
    / shoulder.{L} arm.{L} arm.{L}.001 hand.{L} /
limbs of three = hips spine1 spine2 spine3 neck head / leg1_{L} leg2_{L} leg3_{L} - / - arm1_{L} arm2_{L} arm3_{L} /
DeepMotion = hips_JNT spine_JNT spine1_JNT spine2_JNT neck_JNT head_JNT
    / {l}_upleg_JNT {l}_leg_JNT {l}_foot_JNT {l}_toebase_JNT
    / {l}_shoulder_JNT {l}_arm_JNT {l}_forearm_JNT {l}_hand_JNT / {l}_handIndex1_JNT<{l}_hand_JNT
Rigify = DEF-spine DEF-spine.001 DEF-spine.002 DEF-spine.003 DEF-spine.004 DEF-spine.006
    / DEF-thigh.{L} DEF-shin.{L} DEF-foot.{L} DEF-toe.{L}
    / DEF-shoulder.{L} DEF-upper_arm.{L} DEF-forearm.{L} DEF-hand.{L}
    / root>DEF-spine DEF-spine.005>DEF-spine.006 DEF-pelvis.{L}<DEF-spine DEF-thigh.{L}.001>DEF-shin.{L}
    DEF-upper_arm.{L}.001>DEF-forearm.{L} DEF-forearm.{L}.001>DEF-hand.{L} DEF-shin.{L}.001>DEF-foot.{L}
    DEF-breast.{L}<DEF-spine.003 ORG-spine<root ORG-thigh.{L}<ORG-spine ORG-shin.{L}<ORG-thigh.{L}
    ORG-foot.{L}<ORG-shin.{L} MCH-thigh_ik.{L}<root thigh_ik.{L}<root foot_ik.{L}<root hand_ik.{L}<root
Rigify metarig = spine spine.001 spine.002 spine.003 spine.004 spine.006 / thigh.{L} shin.{L} foot.{L} toe.{L}
    / shoulder.{L} upper_arm.{L} forearm.{L} hand.{L}
    / spine.005>spine.006 pelvis.{L}<spine heel.02.{L}<foot.{L} breast.{L}<spine.003 face<spine.006
    palm.01.{L}<hand.{L}
Auto-Rig Pro = root.x spine_01.x spine_02.x spine_03.x neck.x head.x
    / thigh_stretch.{l} leg_stretch.{l} foot.{l} toes_01.{l}
    / shoulder.{l} arm_stretch.{l} forearm_stretch.{l} hand.{l}
    / thigh_twist.{l}<thigh_stretch.{l} arm_twist.{l}<arm_stretch.{l}
Perception Neuron = Robot_Hips Robot_Spine Robot_Spine1 Robot_Spine2 Robot_Neck Robot_Head
    / Robot_{S}UpLeg Robot_{S}Leg Robot_{S}Foot - / Robot_{S}Shoulder Robot_{S}Arm Robot_{S}ForeArm Robot_{S}Hand
    / Robot_{S}InHandIndex<Robot_{S}Hand Robot_{S}HandIndex<Robot_{S}InHandIndex
HumanIK = Character1_Hips Character1_Spine Character1_Spine1 Character1_Spine2 Character1_Neck Character1_Head
    / Character1_{S}UpLeg Character1_{S}Leg Character1_{S}Foot Character1_{S}ToeBase
    / Character1_{S}Shoulder Character1_{S}Arm Character1_{S}ForeArm Character1_{S}Hand
    / Character1_Reference>Character1_Hips Character1_{S}UpLegRoll<Character1_{S}UpLeg
MB-Lab = pelvis spine01 spine02 spine03 neck head / thigh_{L} calf_{L} foot_{L} toes_{L}
    / clavicle_{L} upperarm_{L} lowerarm_{L} hand_{L}
    / root>pelvis breast_{L}<spine03 thigh_twist_{L}<thigh_{L} thumb01_{L}<hand_{L}
MakeHuman = root spine05 spine03 spine01 neck01 head / upperleg01.{L} lowerleg01.{L} foot.{L} toe1-1.{L}
    / clavicle.{L} upperarm01.{L} lowerarm01.{L} wrist.{L}
    / pelvis.{L}>upperleg01.{L} upperleg02.{L}>lowerleg01.{L} lowerleg02.{L}>foot.{L} toe2-1.{L}<foot.{L}
    shoulder01.{L}>upperarm01.{L} upperarm02.{L}>lowerarm01.{L} lowerarm02.{L}>wrist.{L} spine04>spine03
    spine02>spine01 neck02>head neck03>head
LAFAN1 = Hips Spine Spine1 Spine2 Neck Head / {S}UpLeg {S}Leg {S}Foot {S}Toe / {S}Shoulder {S}Arm {S}ForeArm {S}Hand /
SOMA-77 = Hips Spine1 Spine2 Chest Neck1 Head / {S}Leg {S}Shin {S}Foot {S}ToeBase
    / {S}Shoulder {S}Arm {S}ForeArm {S}Hand
    / Root>Hips Neck2>Head Jaw<Head {S}Eye<Head {S}HandThumb1<{S}Hand {S}ToeEnd<{S}ToeBase
MHR = root c_spine0 c_spine2 c_spine3 c_neck c_head / {l}_upleg {l}_lowleg {l}_foot {l}_ball
    / {l}_clavicle {l}_uparm {l}_lowarm {l}_wrist
    / body_world>root c_spine1>c_spine2 {l}_upleg_twist1_proc<{l}_upleg {l}_talocrural>{l}_ball {l}_subtalar>{l}_ball
    {l}_transversetarsal>{l}_ball {l}_uparm_twist1_proc<{l}_uparm {l}_wrist_twist>{l}_wrist {l}_index1<{l}_wrist
    c_jaw<c_head c_neck_twist0_proc<c_neck
Bandai-Namco = Hips Spine - Chest Neck Head / UpperLeg_{L} LowerLeg_{L} Foot_{L} Toes_{L}
    / Shoulder_{L} UpperArm_{L} LowerArm_{L} Hand_{L} / joint_Root>Hips
DeepMimic = root - - chest neck - / {s}_hip {s}_knee {s}_ankle - / - {s}_shoulder {s}_elbow {s}_wrist /
AMP = pelvis - - torso head - / {s}_thigh {s}_shin {s}_foot - / - {s}_upper_arm {s}_lower_arm {s}_hand /
ReActIdle = pelvis spine - spine.001 neck face / thigh.{L} shin.{L} foot.{L} foot.{L}_end
    / shoulder.{L} upper_arm.{L} forearm.{L} forearm.{L}_end / pelvis.{L}<pelvis face_end<face
Kinect = SpineBase SpineMid - SpineShoulder Neck Head / Hip{S} Knee{S} Ankle{S} Foot{S}
    / - Shoulder{S} Elbow{S} Wrist{S} / Hand{S}<Wrist{S} HandTip{S}<Hand{S} Thumb{S}<Hand{S}
Meta = Hips SpineLower SpineUpper Chest Neck Head / {S}LegUpper {S}LegLower {S}FootAnkle {S}FootBall
    / {S}Scapula {S}ArmUpper {S}ArmLower {S}HandWrist
    / Root>Hips SpineMiddle>SpineUpper {S}Shoulder>{S}Scapula {S}HandPalm<{S}HandWrist
ARKit = hips_joint spine_1_joint spine_3_joint spine_5_joint neck_1_joint head_joint
    / {s}_upLeg_joint {s}_leg_joint {s}_foot_joint {s}_toes_joint
    / {s}_shoulder_1_joint {s}_arm_joint {s}_forearm_joint {s}_hand_joint
    / root>hips_joint spine_2_joint>spine_3_joint spine_4_joint>spine_5_joint neck_2_joint>head_joint
    {s}_toesEnd_joint<{s}_toes_joint jaw_joint<head_joint
AdvancedSkeleton = Root_M Spine1_M Spine2_M Chest_M Neck_M Head_M / Hip_{L} Knee_{L} Ankle_{L} Toes_{L}
    / Scapula_{L} Shoulder_{L} Elbow_{L} Wrist_{L} / HipPart1_{L}<Hip_{L} Jaw_M<Head_M
MMD, Cats = Hips Spine - Chest Neck Head / {S}_leg {S}_knee {S}_ankle {S}_toe
    / {S}_shoulder {S}_arm {S}_elbow {S}_wrist /
MMD = 下半身 上半身 - 上半身2 首 頭 / {J}足 {J}ひざ {J}足首 {J}つま先 / {J}肩 {J}腕 {J}ひじ {J}手首
    / センター>下半身 {J}足D<下半身 {J}ひざD<{J}足D {J}腕捩<{J}腕 {J}親指1<{J}手首 {J}目<頭
OpenSim = pelvis - - torso - head / femur_{l} tibia_{l} talus_{l} toes_{l} / - humerus_{l} ulna_{l} hand_{l}
    / calcn_{l}>toes_{l} radius_{l}>hand_{l}
Roblox = LowerTorso - - UpperTorso - Head / {S}UpperLeg {S}LowerLeg {S}Foot - / - {S}UpperArm {S}LowerArm {S}Hand
    / HumanoidRootPart>LowerTorso
Mova = Root LowerBack Thorax Thorax2 Neck head / {L}_Femur {L}_Tibia {L}_Foot {L}_Toe
    / {L}_Collar {L}_Humerus {L}_Elbow {L}_Wrist /
"""
FAMILIES: dict[str, list[str]] = {
    name: [" ".join(part.split()) for part in parts.split("/")]
    for name, parts in (family.split(" = ") for family in re.split(r"\n(?=\S)", _TEXT.strip()))
}
_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_LIMBS = (("hip", "knee", "ankle", "foot"), ("collar", "shoulder", "elbow", "wrist"))


def made(family: str) -> tuple[Skeleton, dict[str, str]]:
    """A rig of a family with the standard's bones, and what is what: standard name -> its own."""
    trunk, *limbs, more = FAMILIES[family]
    both = [
        {"S": s.title(), "s": s, "L": s[0].upper(), "l": s[0], "J": j} for s, j in (("left", "左"), ("right", "右"))
    ]
    truth = dict(zip(_TRUNK, trunk.split(), strict=True))
    for side in both:
        for parts, names in zip(_LIMBS, limbs, strict=True):
            truth |= {f"{side['s']}_{part}": n.format(**side) for part, n in zip(parts, names.split(), strict=True)}
    truth = {name: own for name, own in truth.items() if own != "-"}
    above: dict[str, str] = {}
    for name, own in truth.items():
        up = STANDARD.parents[STANDARD.index(name)]
        while up >= 0 and STANDARD.names[up] not in truth:
            up = STANDARD.parents[up]
        above[own] = truth[STANDARD.names[up]] if up >= 0 else ""
    stand = STANDARD.rest_positions()
    place = {own: stand[STANDARD.index(name)] for name, own in truth.items()}
    for word in dict.fromkeys(w.format(**side) for w in more.split() for side in both):
        if "<" in word:
            name, _, parent = word.partition("<")
            above[name], place[name] = parent, place[parent] + 0.02
        else:
            name, _, child = word.partition(">")
            if name not in above:
                above[name], up = above[child], above[child]
                place[name] = (place[child] + place[up]) / 2 if up else place[child]
            above[child] = name
    names, left = [], list(above)
    while left:
        names += [n for n in left if above[n] in names or not above[n]]
        left = [n for n in left if n not in names]
    parents = tuple(names.index(above[n]) if above[n] else -1 for n in names)
    offsets = torch.stack([place[n] - (place[above[n]] if above[n] else place[n]) for n in names])
    return Skeleton(tuple(names), parents, offsets), truth
