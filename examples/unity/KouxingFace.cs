// Unity 2021 or newer: add this component to an avatar. It moves every SkinnedMeshRenderer below the
// avatar that has blendshapes of ARKit, Oculus or VRM, also under the names of other programs.

using System;
using System.Collections.Generic;
using System.Linq;
using UnityEngine;

public sealed class KouxingFace : MonoBehaviour
{
    [SerializeField] string gateway = "ws://127.0.0.1:8080";
    [SerializeField, Tooltip("Session to follow; if empty, the newest")] string session = "";
    [SerializeField, Tooltip("Unity's blendshapes range from 0 to 100")] float fullWeight = 100f;

    readonly List<(SkinnedMeshRenderer mesh, int shape, string name)> _shapes =
        new List<(SkinnedMeshRenderer, int, string)>();
    KouxingStream _stream;

    void OnEnable()
    {
        _shapes.Clear();
        var names = GetComponentsInChildren<SkinnedMeshRenderer>().Where(mesh => mesh.sharedMesh).ToDictionary(mesh => mesh, mesh =>
            Enumerable.Range(0, mesh.sharedMesh.blendShapeCount).Select(mesh.sharedMesh.GetBlendShapeName).ToList());
        string set;
        try { set = KouxingShapeNames.ChooseSet(names.Values.SelectMany(list => list).ToList()); }
        catch (InvalidOperationException error)
        {
            Debug.LogError($"kouxing: {error.Message}", this);
            enabled = false;
            return;
        }
        foreach (var mesh in names)
            foreach (var shape in KouxingShapeNames.FindShapes(set, mesh.Value))
                _shapes.Add((mesh.Key, mesh.Value.IndexOf(shape.Key), shape.Value));
        _stream = new KouxingStream(gateway, session, set);
    }

    void OnDisable()
    {
        _stream?.Dispose();
        _stream = null;
    }

    void LateUpdate() // after the Animator
    {
        if (_stream == null) return;
        IReadOnlyList<string> names = _stream.Names;
        float[] weights = _stream.Weights;
        if (weights.Length != names.Count) return;
        var face = new Dictionary<string, float>();
        for (int i = 0; i < weights.Length; i++) face[names[i]] = weights[i];
        foreach (var target in _shapes)
            if (face.TryGetValue(target.name, out float weight))
                target.mesh.SetBlendShapeWeight(target.shape, fullWeight * weight);
    }
}
